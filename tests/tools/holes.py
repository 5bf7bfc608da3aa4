"""Deletes each thing of rendered rooms, over HTTP, and holds `kind=holes` to what no photo saw.

    make eval-scenes
    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/holes.py target/eval/scenes/scene_00

A thing's pixels, by its true mask, are unseen where none of the photos shows what is behind it, by
the room's geometry (`rooms.py`). A pixel is marked where `holes` is a half and more. By its word,
if that finds the thing (IoU of 0.85 in the first photo), or with `--by box` by its true box, 3 cm
wider and 1 cm above the ground. Of each thing: its pixels, which share is unseen; the share of
unseen ones that is marked (also of those 3 pixels and more within), the share of marked ones that
is unseen, and that is of the thing at all; and of its pixels that were seen, the share marked.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from deletions import AROUND, LEAST_PIXELS, MARGIN, PHOTOS, grown, made
from PIL import Image
from rooms import Rooms, places, seen_by

import segsplat

LEAST_IOU, WIDER, ABOVE = 0.85, 0.03, 0.01


def unseen_behind(
    rooms: Rooms, number: int, word: str, depths: list, frames: list, told: dict, thing: np.ndarray
) -> np.ndarray:
    """[N, H, W] pixels of a thing that no photo saw what is behind of; `depths` are true ones."""
    # A photo that shows the thing does not show what touches it, either.
    depths = [np.where(mask, 0, depth) for mask, depth in zip(thing, depths, strict=True)]
    unseen = thing.copy()
    for i, frame in enumerate(frames):
        behind = places(frame, told, rooms.seen(number, frame, told, without=word))
        for photo, depth in zip(frames, depths, strict=True):
            unseen[i] &= ~seen_by(photo, told, depth, behind)
    return unseen


def box_of(thing: dict) -> dict:
    """The true box of a thing, a little wider, and not of what it stands on."""
    center, size = np.array(thing["box"]["center"]), np.array(thing["box"]["size"])
    axes = np.array(thing["box"]["axes"])  # The last one is up.
    center = center + axes[2] * (WIDER + ABOVE) / 2
    size = size + [2 * WIDER, 2 * WIDER, WIDER - ABOVE]
    return {"center": center.tolist(), "size": size.tolist(), "axes": axes.tolist()}


def told_of(thing: np.ndarray, unseen: np.ndarray, marked: np.ndarray) -> str:
    inner = np.stack([~grown(~one, MARGIN) for one in unseen])
    share = {
        "unseen": unseen.sum() / thing.sum(),
        "of these marked": marked[unseen].mean(),
        f"{MARGIN} pixels within": marked[inner].mean() if inner.any() else np.nan,
        "of the marked unseen": unseen[marked].mean() if marked.any() else np.nan,
        "of the thing": thing[marked].mean() if marked.any() else np.nan,
        "of its seen ones marked": marked[thing & ~unseen].mean(),
    }
    return f"{thing.sum()} pixels, " + ", ".join(f"{k} {v:.1%}" for k, v in share.items())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--by", choices=["word", "box"], default="word")
    given = parser.parse_args()
    rooms, everything = Rooms(), []
    with segsplat.local(flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}) as client:
        for folder in given.folders:
            scene, names = made(client, folder, "eager" if given.by == "word" else "off")
            told = json.loads((folder / "transforms.json").read_text())
            frames = told["frames"][: 3 * PHOTOS : 3]
            number = int(folder.name.removeprefix("scene_"))
            depths = [rooms.seen(number, frame, told) for frame in frames]
            truth = np.stack([np.asarray(Image.open(folder / "masks" / name)) for name in names])
            classes = json.loads((folder / "masks/classes.json").read_text())
            boxes = {one["name"]: box_of(one)
                     for one in json.loads((folder / "scene.json").read_text())["objects"]}
            for value, word in classes.items():
                thing = truth == int(value)
                if word in AROUND or thing.sum() < LEAST_PIXELS:
                    continue
                if given.by == "word":
                    found = scene.query(word)
                    iou = 0.0
                    if found[0].found:
                        mask = found[0].mask
                        iou = (mask & thing[0]).sum() / (mask | thing[0]).sum()
                    if iou < LEAST_IOU:
                        print(f"{folder.name} {word}: not found (IoU {iou:.2f})", flush=True)
                        continue
                    found.hide()
                else:
                    scene.set_edits([{"op": "delete", "select": {"box": boxes[word]}}])
                height, width = thing.shape[1:]
                marked = np.stack([
                    scene.view("holes", from_=i, width=width, height=height).holes >= 0.5
                    for i in range(len(names))])
                scene.set_edits([])
                unseen = unseen_behind(rooms, number, word, depths, frames, told, thing)
                everything.append((thing, unseen, marked))
                print(f"{folder.name} {word}: {told_of(*everything[-1])}", flush=True)
            scene.delete()
    if everything:
        whole = map(np.concatenate, zip(*everything, strict=True))
        print(f"all {len(everything)}: {told_of(*whole)}")


if __name__ == "__main__":
    main()
