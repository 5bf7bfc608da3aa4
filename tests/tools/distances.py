"""One length given: how exact other distances of rendered rooms are, and the ground, over HTTP.

    make eval-scenes
    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/distances.py --photos 8 --refine 20000 target/eval/scenes/scene_*

The rooms are in metres and their floor is y = 0, so a pixel of the floor has an exact place. Their
cameras are sent in units of 0.27 m. Points of the floor are picked in each photo; the length
between the two that are farthest apart is given, and all other distances over half a metre are
compared.
Of the ground: how many degrees its normal is off, and its height at its middle.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import segsplat

GRID, UNIT, SHORT = 5, 0.27, 0.5


def made(
    client: segsplat.Client, folder: Path, photos: int, refine: int
) -> tuple[segsplat.Scene, list[dict], dict]:
    """A scene of photos spread over the room in units of UNIT, refined for some milliseconds, and
    its frames in metres."""
    told = json.loads((folder / "transforms.json").read_text())
    every = len(told["frames"]) // photos
    frames = told["frames"][: every * photos : every]
    sent = []
    with tempfile.TemporaryDirectory() as scratch:
        to = Path(scratch)
        (to / "images").mkdir()
        for frame in frames:
            name = Path(frame["file_path"]).name
            shutil.copy(folder / "images" / name, to / "images")
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] /= UNIT
            sent.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
        (to / "transforms.json").write_text(json.dumps({**told, "frames": sent}))
        scene = client.scene(to, semantics="off", progress=False)
    if refine:
        scene.refine(refine)
        list(scene.events())
    return scene, frames, told


def floor_points(scene: segsplat.Scene, folder: Path, frames: list[dict], told: dict) -> np.ndarray:
    """[N, 2, 3] picked and true places of pixels of the floor."""
    classes = json.loads((folder / "masks/classes.json").read_text())
    floor = next(int(value) for value, word in classes.items() if word == "floor")
    found = []
    for i, frame in enumerate(frames):
        mask = np.asarray(Image.open(folder / "masks" / Path(frame["file_path"]).name)) == floor
        pose = np.array(frame["transform_matrix"])
        for u, v in itertools.product(range(1, 2 * GRID, 2), repeat=2):
            x, y = told["w"] * u // (2 * GRID), told["h"] * v // (2 * GRID)
            if not mask[y - 3 : y + 4, x - 3 : x + 4].all():
                continue
            at = (x + 0.5 - told["cx"]) / told["fl_x"], (y + 0.5 - told["cy"]) / told["fl_y"]
            ray = pose[:3, :3] @ np.array([at[0], -at[1], -1.0])  # OpenGL camera axes
            true = pose[:3, 3] - ray * (pose[1, 3] / ray[1])
            point = scene.pick(x + 0.5, y + 0.5, from_=i).point
            if point is not None:
                found.append((np.array(point), true))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--photos", type=int, default=4)
    parser.add_argument("--refine", type=int, default=0, help="milliseconds")
    given = parser.parse_args()
    everything = []
    with segsplat.local(flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}) as client:
        for folder in given.folders:
            scene, frames, told = made(client, folder, given.photos, given.refine)
            points = floor_points(scene, folder, frames, told)
            if len(points) < 4:
                print(f"{folder.name}: {len(points)} points of the floor are too few", flush=True)
                continue
            true = np.linalg.norm(points[:, None, 1] - points[None, :, 1], axis=-1)
            a, b = np.unravel_index(true.argmax(), true.shape)
            scale = scene.set_scale(float(true[a, b]), points=points[[a, b], 0].tolist())
            errors = []
            for i, j in itertools.combinations(range(len(points)), 2):
                if true[i, j] > SHORT and {i, j} != {a, b}:
                    got = scene.measure(points[[i, j], 0].tolist()).length
                    errors.append(abs(got / true[i, j] - 1))
            everything += errors
            ground, said = scale.ground, "no ground"
            if ground is not None:
                off = np.degrees(np.arccos(np.clip(-ground.normal[1], -1, 1)))
                said = f"ground {off:.2f} degrees off, {-ground.point[1] * UNIT:+.3f} m"
            share = 100 * np.quantile(errors, [0.5, 0.9, 1])
            print(f"{folder.name}: {len(points)} points, {len(errors)} distances, off by "
                  f"{share[0]:.2f} % (median), {share[1]:.2f} (of 9 in 10), {share[2]:.2f} (most); "
                  f"a unit is {scale.metres_per_unit:.4f} m ({UNIT}); {said}", flush=True)
            scene.delete()
    share = 100 * np.quantile(everything, [0.5, 0.9, 1])
    within = 100 * np.mean(np.array(everything) <= 0.01)
    print(f"all: {len(everything)} distances, off by {share[0]:.2f} % (median), {share[1]:.2f} (of "
          f"9 in 10), {share[2]:.2f} (most); {within:.0f} % within 1 %")


if __name__ == "__main__":
    main()
