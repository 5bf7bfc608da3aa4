"""The true geometry of the rendered rooms of `make eval-scenes`: which thing a pixel of any camera
sees, and how far it is, also without one of the things. It needs what `make eval-scenes` needs.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "models/training/semantics"))
DATA = os.environ.get("SEGSPLAT_SHARED_DATA", str(ROOT.parent / "shared/data"))


class Rooms:
    """The rooms by their number: `scene_07` is 7."""

    def __init__(self) -> None:
        import eval_scenes  # of models/training

        self._of = eval_scenes
        self._maker = eval_scenes.Maker(DATA)
        self._composed: list[tuple] = []

    def _room(self, number: int) -> tuple:
        # Which things are in a room depends on those before.
        while len(self._composed) <= number:
            self._composed.append(self._of.compose(self._maker, len(self._composed)))
        return self._composed[number]

    def seen(self, number: int, frame: dict, told: dict, without: str | None = None) -> np.ndarray:
        """[H, W] depth along the axis of the camera of a frame of `transforms.json`, metres;
        without the things of one name, where one is given."""
        things, labels, kept, light, _ = self._room(number)
        gone = {one["instance"] for one in kept if one["name"] == without}
        assert gone or without is None, f"room {number} has no {without}"
        left = np.stack([things[i] for i in range(len(labels)) if i not in gone])
        pose = np.array(frame["transform_matrix"])[:3] @ np.diag([1.0, -1.0, -1.0, 1.0])
        camera = np.concatenate([pose.ravel(), [told[k] for k in ("fl_x", "fl_y", "cx", "cy")]])
        size = told["w"], told["h"]
        return self._maker.caster.render(left, light, camera, *size, 1, colour=False)[1]


def places(frame: dict, told: dict, depth: np.ndarray) -> np.ndarray:
    """[H, W, 3] where the pixels of a frame are at these depths."""
    y, x = np.mgrid[0 : told["h"], 0 : told["w"]] + 0.5
    ray = [(x - told["cx"]) / told["fl_x"], (told["cy"] - y) / told["fl_y"], -np.ones_like(x)]
    pose = np.array(frame["transform_matrix"])
    return (np.stack(ray, -1) * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def seen_by(frame: dict, told: dict, depth: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Whether a photo, whose true depth is known, shows places [..., 3]: nothing is in front."""
    pose = np.array(frame["transform_matrix"])
    x, y, z = np.moveaxis((at - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1], -1, 0)
    front = z > 1e-6
    u = np.floor(told["fl_x"] * x / np.where(front, z, 1) + told["cx"]).astype(int)
    v = np.floor(told["fl_y"] * y / np.where(front, z, 1) + told["cy"]).astype(int)
    inside = front & (u >= 0) & (u < told["w"]) & (v >= 0) & (v < told["h"])
    found = depth[np.where(inside, v, 0), np.where(inside, u, 0)]
    return inside & (z <= found * 1.01)
