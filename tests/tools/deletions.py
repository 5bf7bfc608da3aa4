"""Deletes each thing of labelled scenes by its word, over HTTP, and holds the views to true masks.

    make eval-scenes
    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/deletions.py target/eval/scenes/scene_01

Of each thing: how good the mask of its word is (IoU in the first photo); the share of its true
pixels that hardly change (under 8 of 255 in each channel; what is behind may look the same); and
the PSNR of all other pixels against the view before, of all and of those 3 pixels and more away.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from captures import capture
from PIL import Image

import segsplat

PHOTOS, LEAST_PIXELS, CHANGED, MARGIN = 4, 800, 8, 3
AROUND = {"floor", "wall", "table"}


def grown(mask: np.ndarray, by: int) -> np.ndarray:
    for _ in range(by):
        p = np.pad(mask, 1)
        mask = p[1:-1, 1:-1] | p[:-2, 1:-1] | p[2:, 1:-1] | p[1:-1, :-2] | p[1:-1, 2:]
    return mask


def psnr(before: np.ndarray, after: np.ndarray, where: np.ndarray) -> float:
    error = np.mean((before.astype(float) - after)[where] ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def made(
    client: segsplat.Client, folder: Path, semantics: str = "eager"
) -> tuple[segsplat.Scene, list[str]]:
    """A scene of every third photo, and the names of their masks."""
    told = json.loads((folder / "transforms.json").read_text())
    frames = told["frames"][: 3 * PHOTOS : 3]
    with tempfile.TemporaryDirectory() as scratch:
        part = capture(folder, told, frames, Path(scratch))
        scene = client.scene(part, semantics=semantics, progress=False)
    return scene, [Path(frame["file_path"]).name for frame in frames]


def seen(scene: segsplat.Scene, truth: np.ndarray) -> np.ndarray:
    """The views of all photos, in the size of their masks."""
    count, height, width = truth.shape
    views = [scene.view(from_=i, width=width, height=height).image for i in range(count)]
    return np.stack(views)


def main(folders: list[Path]) -> None:
    with segsplat.local(flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}) as client:
        for folder in folders:
            scene, names = made(client, folder)
            truth = np.stack([np.asarray(Image.open(folder / "masks" / name)) for name in names])
            before = seen(scene, truth)
            classes = json.loads((folder / "masks/classes.json").read_text())
            for value, word in classes.items():
                thing = truth == int(value)
                if word in AROUND or thing.sum() < LEAST_PIXELS:
                    continue
                found = scene.query(word)
                if not found[0].found:
                    print(f"{folder.name} {word}: not found", flush=True)
                    continue
                iou = (found[0].mask & thing[0]).sum() / (found[0].mask | thing[0]).sum()
                found.hide()
                after = seen(scene, truth)
                scene.set_edits([])
                same = np.abs(after.astype(int) - before).max(-1) < CHANGED
                near = np.stack([grown(one, MARGIN) for one in thing])
                print(f"{folder.name} {word}: IoU {iou:.2f}, left {same[thing].mean():.1%}, "
                      f"others {psnr(before, after, ~thing):.1f} dB, {MARGIN} pixels away "
                      f"{psnr(before, after, ~near):.1f} dB", flush=True)


if __name__ == "__main__":
    main([Path(one) for one in sys.argv[1:]])
