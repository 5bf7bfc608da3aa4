"""One length given: how exact other distances of rendered rooms are, and the ground, over HTTP.

    make eval-scenes
    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/distances.py --photos 8 --refine 20000 target/eval/scenes/scene_*

The rooms are in metres, and where each pixel is, is known (`rooms.py`). Their cameras are sent in
units of 0.27 m. Points of surfaces (`--on floor`; also `wall`, and `table`: its top) are picked in
each photo. Of the first surface that has four points, the length between the two that are farthest
apart is given; all other distances on a surface over half a metre (of the table: over 0.1 m) are
compared; also with the unit known, and of places that two photos and more show.
Of the ground: how many degrees its normal is off, and its height at its middle.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
from pathlib import Path

import numpy as np
from captures import capture
from PIL import Image
from rooms import Rooms, places, seen_by

import segsplat

GRID, UNIT = 5, 0.27
# Shorter distances are not compared, metres.
SHORT = {"floor": 0.5, "wall": 0.5, "table": 0.1}


def made(
    client: segsplat.Client, folder: Path, photos: int, refine: int
) -> tuple[segsplat.Scene, list[dict], dict]:
    """A scene of photos spread over the room in units of UNIT, refined for some milliseconds, and
    its frames in metres."""
    told = json.loads((folder / "transforms.json").read_text())
    every = len(told["frames"]) // photos
    frames = told["frames"][: every * photos : every]
    sent = []
    for frame in frames:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] /= UNIT
        sent.append({**frame, "transform_matrix": pose.tolist()})
    with tempfile.TemporaryDirectory() as scratch:
        part = capture(folder, told, sent, Path(scratch))
        scene = client.scene(part, semantics="off", progress=False)
    if refine:
        scene.refine(refine)
        list(scene.events())
    return scene, frames, told


def points_on(
    surface: str,
    scene: segsplat.Scene,
    folder: Path,
    told: dict,
    seen: list[tuple[dict, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """[N, 2, 3] picked and true places of pixels of a surface, and how many photos show each;
    `seen` has each frame and its true depths."""
    classes = json.loads((folder / "masks/classes.json").read_text())
    value = {word: int(value) for value, word in classes.items()}.get(surface)
    masks = [np.asarray(Image.open(folder / "masks" / Path(frame["file_path"]).name)) == value
             for frame, _ in seen]
    at = [places(frame, told, depth) for frame, depth in seen]
    if surface == "table" and np.any(masks):
        # Its top, and not its sides and legs.
        top = min(at[mask][:, 1].min() for mask, at in zip(masks, at, strict=True) if mask.any())
        masks = [mask & (at[..., 1] < top + 1e-3) for mask, at in zip(masks, at, strict=True)]
    found, shown = [], []
    for i, mask in enumerate(masks):
        height, width = mask.shape
        for u, v in itertools.product(range(1, 2 * GRID, 2), repeat=2):
            x, y = width * u // (2 * GRID), height * v // (2 * GRID)
            if not mask[y - 3 : y + 4, x - 3 : x + 4].all():
                continue
            point = scene.pick(x + 0.5, y + 0.5, from_=i).point
            if point is not None:
                true = at[i][y, x]
                found.append((np.array(point), true))
                shown.append(sum(seen_by(frame, told, depth, true) for frame, depth in seen))
    return np.array(found), np.array(shown)


def between(points: np.ndarray) -> np.ndarray:
    """[N, N] true distances."""
    return np.linalg.norm(points[:, None, 1] - points[None, :, 1], axis=-1)


def scaled(scene: segsplat.Scene, points: np.ndarray) -> tuple[segsplat.Scale, str]:
    """The size after the longest of the distances is given, and what is said of it."""
    true = between(points)
    ends = list(np.unravel_index(true.argmax(), true.shape))
    scale = scene.set_scale(float(true.max()), points=points[ends, 0].tolist())
    ground, said = scale.ground, "no ground"
    if ground is not None:
        off = np.degrees(np.arccos(np.clip(-ground.normal[1], -1, 1)))
        said = f"ground {off:.2f} degrees off, {-ground.point[1] * UNIT:+.3f} m"
    return scale, f"a unit is {scale.metres_per_unit:.4f} m ({UNIT}); {said}"


def compared(
    scene: segsplat.Scene, scale: segsplat.Scale, points: np.ndarray, short: float, given: bool
) -> tuple[list[float], list[float]]:
    """How much distances between the points are off, by the given length and with the unit known.
    Where it is `given` on this surface, that length itself is left out."""
    true, of, known = between(points), [], []
    for i, j in itertools.combinations(range(len(points)), 2):
        if true[i, j] > short and not (given and true[i, j] == true.max()):
            units = np.linalg.norm(points[i, 0] - points[j, 0])
            of.append(abs(scale.metres_per_unit * units / true[i, j] - 1))
            known.append(abs(UNIT * units / true[i, j] - 1))
    # What the server says of the first and the last of them.
    units = float(np.linalg.norm(points[0, 0] - points[-1, 0]))
    said = scene.measure(points[[0, -1], 0].tolist()).length
    assert np.isclose(said, scale.metres_per_unit * units), (said, scale, units)
    return of, known


def told_of(errors: list[float], known: list[float]) -> str:
    share = 100 * np.quantile(errors, [0.5, 0.9, 1])
    return (f"{len(errors)} distances, off by {share[0]:.2f} % (median), {share[1]:.2f} (of 9 in "
            f"10), {share[2]:.2f} (most), {100 * np.mean(np.array(errors) <= 0.01):.0f} % within "
            f"1 %; with the unit known {100 * np.median(known):.2f} % (median)")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--photos", type=int, default=4)
    parser.add_argument("--refine", type=int, default=0, help="milliseconds")
    parser.add_argument("--on", nargs="+", choices=SHORT, default=["floor"])
    given = parser.parse_args()
    rooms = Rooms()
    all_of: dict[tuple[str, int], tuple[list[float], list[float]]] = {}
    with segsplat.local(flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}) as client:
        for folder in given.folders:
            scene, frames, told = made(client, folder, given.photos, given.refine)
            number = int(folder.name.removeprefix("scene_"))
            seen = [(frame, rooms.seen(number, frame, told)) for frame in frames]
            scale = None
            for on in given.on:
                points, shown = points_on(on, scene, folder, told, seen)
                if len(points) < 4:
                    print(f"{folder.name} {on}: {len(points)} points are too few", flush=True)
                    continue
                first = scale is None
                if scale is None:
                    scale, said = scaled(scene, points)
                    print(f"{folder.name}: {said}", flush=True)
                for least in (1, 2):
                    some = points[shown >= least]
                    if len(some) < 4:
                        continue
                    errors = compared(scene, scale, some, SHORT[on], first)
                    print(f"{folder.name} {on}: {len(some)} points that {least} photos and more "
                          f"show, {told_of(*errors)}", flush=True)
                    for all_errors, of in zip(
                        all_of.setdefault((on, least), ([], [])), errors, strict=True
                    ):
                        all_errors.extend(of)
            scene.delete()
    for (on, least), errors in all_of.items():
        print(f"all {on}, {least} photos and more: {told_of(*errors)}")


if __name__ == "__main__":
    main()
