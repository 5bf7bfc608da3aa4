"""COLMAP on photos whose cameras are hidden, beside `segsplat-lab cameras` and `rendered`.

    python colmap_cameras.py SCENES OUT.jsonl --photos 8 [--neighbours] [--scenes fox,terrace]

SCENES is a folder of folders with a `transforms.json`. Of each the same photos are taken as the
laboratory takes: PHOTOS spread evenly over the capture, or as many that follow each other from its
middle; 0 are all. SIFT, exhaustive matching and the incremental mapper of pycolmap with their
defaults, but that all photos have one camera, as ours have (`--mode AUTO`: a camera each). Of
several models the one with most photos counts. OUT takes a row a scene, with the errors that the
laboratory's rows have: rotations after the one turn of the world that makes the median error least,
centres after scale and shift, as a share of the longest way between two true ones. Needs pycolmap
and numpy."""

import argparse
import json
import os
import pathlib
import shutil
import tempfile
import time

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("folder", type=pathlib.Path)
parser.add_argument("out", type=pathlib.Path)
parser.add_argument("--photos", type=int, default=0)
parser.add_argument("--neighbours", action="store_true")
parser.add_argument("--scenes", default="")
parser.add_argument("--mode", default="SINGLE", choices=["SINGLE", "AUTO"])
parser.add_argument("--threads", type=int, default=1)
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--machine", default="")
args = parser.parse_args()
for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ[f"{library}_NUM_THREADS"] = str(args.threads)

import numpy as np  # noqa: E402
import pycolmap  # noqa: E402

pycolmap.logging.minloglevel = pycolmap.logging.ERROR


def taken(count):
    """The places of the photos of a capture of `count`; none where it has too few."""
    n = args.photos or count
    if n > count:
        return []
    if args.neighbours:
        return [(count - n) // 2 + i for i in range(n)]
    return [i * (count - 1) // (n - 1) for i in range(n)]


def angle_deg(turn):
    """Angle of a rotation."""
    skew = turn - turn.T
    sine = np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]])
    return float(np.degrees(np.arctan2(sine, np.trace(turn) - 1)))


def mean_turn(turns):
    """The turn of the world: that of least median error, then the mean of those within a degree."""
    medians = [np.sort([angle_deg(b @ a.T) for b in turns])[len(turns) // 2] for a in turns]
    best = turns[int(np.argmin(medians))]
    near = sum(turn for turn in turns if angle_deg(turn @ best.T) <= 1)
    u, _, vt = np.linalg.svd(near)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def errors(truth, solved):
    """Median and largest error of rotations, degrees, and of centres, a share."""
    if len(solved) < 2:
        names = ("rotation_deg", "rotation_worst_deg", "position", "position_worst")
        return dict.fromkeys(names)
    names = sorted(solved)
    world = mean_turn([truth[name][0] @ solved[name][0].T for name in names])
    turned = np.sort([angle_deg(truth[n][0] @ (world @ solved[n][0]).T) for n in names])
    a = np.array([truth[name][1] for name in names])
    b = np.array([world @ solved[name][1] for name in names])
    longest = max(np.linalg.norm(p - q) for p in a for q in a)
    a, b = a - a.mean(0), b - b.mean(0)
    scale = (a * b).sum() / max((b * b).sum(), 1e-300)
    moved = np.sort(np.linalg.norm(scale * b - a, axis=1)) / longest
    middle = len(names) // 2
    return {
        "rotation_deg": float(turned[middle]),
        "rotation_worst_deg": float(turned[-1]),
        "position": float(moved[middle]),
        "position_worst": float(moved[-1]),
    }


def scene(folder):
    """The row of a scene."""
    read = json.loads((folder / "transforms.json").read_text())
    frames = read["frames"]
    places = taken(len(frames))
    if not places:
        return None
    truth, wide, foreign = {}, {}, []
    work = pathlib.Path(tempfile.mkdtemp())
    try:
        (work / "images").mkdir()
        for at in places:
            frame = {**read, **frames[at]}
            name = pathlib.Path(frame["file_path"]).name
            shutil.copy(folder / frame["file_path"], work / "images" / name)
            if frame.get("foreign"):
                foreign.append(name)
                continue
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
            truth[name] = (pose[:3, :3] @ np.diag([1, -1, -1]), pose[:3, 3])
            focal, width = frame.get("fl_x"), frame.get("w")
            wide[name] = focal / width if focal and width else None
        begun = time.perf_counter()
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = args.threads
        mode = getattr(pycolmap.CameraMode, args.mode)
        database = work / "database.db"
        cpu = pycolmap.Device.cpu
        pycolmap.set_random_seed(args.seed)
        pycolmap.extract_features(
            database, work / "images", camera_mode=mode, extraction_options=options, device=cpu
        )
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads = args.threads
        pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
        mapping = pycolmap.IncrementalPipelineOptions()
        mapping.num_threads, mapping.random_seed = args.threads, args.seed
        models = pycolmap.incremental_mapping(database, work / "images", work, options=mapping)
        seconds = time.perf_counter() - begun
        solved, ratios, strangers = {}, [], 0
        model = max(models.values(), key=lambda of: of.num_reg_images(), default=None)
        for image in model.images.values() if model else []:
            if not image.has_pose:
                continue
            if image.name in foreign:
                strangers += 1
                continue
            pose = image.cam_from_world().inverse()
            solved[image.name] = (pose.rotation.matrix(), np.array(pose.translation))
            lens = model.cameras[image.camera_id]
            if wide[image.name]:
                ratios.append(lens.mean_focal_length() / lens.width / wide[image.name])
    finally:
        shutil.rmtree(work)
    return {
        "scene": folder.name,
        "photos": len(places),
        "neighbours": args.neighbours,
        "placed": len(solved),
        "expected": len(truth),
        "foreign": len(foreign),
        "foreign_placed": strangers,
        **errors(truth, solved),
        "focal": float(np.sort(ratios)[len(ratios) // 2]) if ratios else None,
        "seconds": seconds,
    }


def main():
    """A row a scene."""
    wanted = [name for name in args.scenes.split(",") if name]
    folders = sorted(path.parent for path in args.folder.glob("*/transforms.json"))
    for folder in folders:
        if wanted and folder.name not in wanted:
            continue
        row = scene(folder)
        if row is None:
            print(f"{folder.name}: fewer than {args.photos} photos", flush=True)
            continue
        told = {"table": "colmap-cameras", "machine": args.machine}
        told |= {"pycolmap": pycolmap.__version__, "mode": args.mode}
        row = {**told, "seed": args.seed, "threads": args.threads, **row}
        with args.out.open("a") as out:
            out.write(json.dumps(row) + "\n")
        shown = ("scene", "placed", "expected", "rotation_deg", "position", "focal", "seconds")
        print(json.dumps({name: row[name] for name in shown}), flush=True)


main()
