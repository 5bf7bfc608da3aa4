"""Nonsense asked of scenes, over HTTP: how much is found, with words that are there beside it.

    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/nonsense.py ../shared/data/scenes/*

Of each scene of four spread photos: 200 strings of 4 to 9 random letters, and 24 plain words of
things, many of which are in no scene. A string that is found is named, with its score.
"""

from __future__ import annotations

import argparse
import json
import random
import string
import tempfile
from pathlib import Path

from captures import capture

import segsplat

PHOTOS, STRINGS, ASKED_AT_ONCE = 4, 200, 100
WORDS = (
    "chair table book box cup bottle lamp door window shelf monitor keyboard toy plant sofa bag "
    "can pot knife fox duck car mouse floor"
).split()


def nonsense() -> list[str]:
    """The same strings at each run."""
    random.seed(39)
    one = lambda: "".join(random.choices(string.ascii_lowercase, k=random.randint(4, 9)))
    return [one() for _ in range(STRINGS)]


def made(client: segsplat.Client, folder: Path) -> segsplat.Scene:
    """A scene of photos spread over the capture."""
    told = json.loads((folder / "transforms.json").read_text())
    frames = told["frames"][:: -(-len(told["frames"]) // PHOTOS)]
    with tempfile.TemporaryDirectory() as scratch:
        part = capture(folder, told, frames, Path(scratch))
        return client.scene(part, semantics="eager", progress=False)


def found(scene: segsplat.Scene, texts: list[str]) -> list[str]:
    """Those that are found, with their scores."""
    parts = [texts[at : at + ASKED_AT_ONCE] for at in range(0, len(texts), ASKED_AT_ONCE)]
    matches = [match for part in parts for match in scene.query(part, masks=False, boxes="none")]
    return [f"{match.text} {match.score:.2f}" for match in matches if match.found]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    folders = parser.parse_args().folders
    strings, taken = nonsense(), 0
    with segsplat.local(flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}) as client:
        for folder in folders:
            scene = made(client, folder)
            wrong, right = found(scene, strings), found(scene, WORDS)
            taken += len(wrong)
            print(f"{folder.name}: {len(wrong)} of {STRINGS} strings ({', '.join(wrong)}), "
                  f"{len(right)} of {len(WORDS)} words", flush=True)  # fmt: skip
    print(f"all: {taken / STRINGS / len(folders):.2%} of strings")


if __name__ == "__main__":
    main()
