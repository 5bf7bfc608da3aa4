"""Photos join a scene over HTTP: how long until they are served, and how good it is before, after,
and made anew of all of them.

    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/joins.py --photos 24 --join 4 ../shared/data/scenes/fox

Every sixth photo is held out and in no scene; of the others as many as are asked for, spread
evenly, are in the scene, and of these as many, spread evenly, join the rest. PSNR of the held-out
photos. The time is from the call to the answer that the scene with them is served; sending and
reading them is in it, and the load of the machine is said.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from captures import capture
from PIL import Image

import segsplat

HELD_OUT = 6


def spread(many: int, few: int) -> list[int]:
    return [int((i + 0.5) * many / few) for i in range(few)]


def straightened(photo: np.ndarray, lens: dict) -> tuple[np.ndarray, np.ndarray]:
    """A photo as a pinhole with its lens would show it, and which pixels it has of it."""
    height, width = photo.shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    x, y = (u - lens["cx"]) / lens["fl_x"], (v - lens["cy"]) / lens["fl_y"]
    k1, k2, p1, p2 = (lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
    r = x * x + y * y
    bent = 1 + k1 * r + k2 * r * r
    u = lens["fl_x"] * (x * bent + 2 * p1 * x * y + p2 * (r + 2 * x * x)) + lens["cx"] - 0.5
    v = lens["fl_y"] * (y * bent + 2 * p2 * x * y + p1 * (r + 2 * y * y)) + lens["cy"] - 0.5
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    u, v = np.clip(u, 0, width - 1.001), np.clip(v, 0, height - 1.001)
    i, j = u.astype(int), v.astype(int)
    a, b = (u - i)[..., None], (v - j)[..., None]
    upper = photo[j, i] * (1 - a) + photo[j, i + 1] * a
    lower = photo[j + 1, i] * (1 - a) + photo[j + 1, i + 1] * a
    return upper * (1 - b) + lower * b, inside


def psnr(scene: segsplat.Scene, folder: Path, told: dict, targets: list[dict]) -> np.ndarray:
    """Of each of the held-out photos."""
    found = []
    for frame in targets:
        lens = {**told, **frame}
        with Image.open(folder / frame["file_path"]) as file:
            photo, inside = straightened(np.asarray(file.convert("RGB")) / 255, lens)
        fx, fy, cx, cy = (lens[name] for name in ("fl_x", "fl_y", "cx", "cy"))
        pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        view = scene.view(camera_to_world=pose, K=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
                          width=lens["w"], height=lens["h"])
        error = np.mean((photo - view.image / 255)[inside] ** 2)
        found.append(-10 * np.log10(error))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--photos", type=int, default=24)
    parser.add_argument("--join", type=int, default=4)
    given = parser.parse_args()
    with (
        segsplat.local(flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}) as client,
        tempfile.TemporaryDirectory() as scratch,
    ):
        for folder in given.folders:
            told = json.loads((folder / "transforms.json").read_text())
            every = told["frames"]
            targets = every[HELD_OUT // 2 :: HELD_OUT]
            rest = [one for one in every if one not in targets]
            some = [rest[i] for i in spread(len(rest), min(given.photos, len(rest)))]
            new = [some[i] for i in spread(len(some), given.join)]
            old = [one for one in some if one not in new]
            to = Path(scratch) / folder.name
            first, more = capture(folder, told, old, to / "a"), capture(folder, told, new, to / "b")
            whole = capture(folder, told, old + new, to / "c")
            scene = client.scene(first, semantics="off", progress=False)
            before = psnr(scene, folder, told, targets)
            load, begun = os.getloadavg()[0], time.monotonic()
            scene.add(more, progress=False)
            took = time.monotonic() - begun
            after = psnr(scene, folder, told, targets)
            scene.delete()
            anew = client.scene(whole, semantics="off", progress=False)
            made = psnr(anew, folder, told, targets)
            anew.delete()
            print(f"{folder.name}: {len(new)} photos join {len(old)} after {took:.1f} s (load "
                  f"{load:.0f} before it); {len(targets)} held-out photos {before.mean():.2f} dB "
                  f"before, {after.mean():.2f} after, one loses at most "
                  f"{(before - after).max():.2f}; made anew {made.mean():.2f}", flush=True)


if __name__ == "__main__":
    main()
