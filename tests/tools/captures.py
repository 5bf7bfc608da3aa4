"""Captures of some photos of another, for tools that measure scenes over HTTP."""

from __future__ import annotations

import json
import shutil
from pathlib import Path


def capture(folder: Path, told: dict, frames: list[dict], to: Path) -> Path:
    """A folder with these frames of the capture in `folder`, whose `transforms.json` is `told`."""
    (to / "images").mkdir(parents=True)
    for frame in frames:
        shutil.copy(folder / frame["file_path"], to / "images")
    sent = [{**one, "file_path": f"images/{Path(one['file_path']).name}"} for one in frames]
    (to / "transforms.json").write_text(json.dumps({**told, "frames": sent}))
    return to
