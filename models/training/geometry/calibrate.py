"""The ranges of activations that cpu_graph.py computes in 8 bits.

    python calibrate.py --graph geometry.onnx --data SHARED --out ranges.json [--views 2] [--wider OLD.json]

Inputs: planes that carry photographs, seen by two cameras, and sets of photos of the scenes that
choose constants; never a scene that is reported. A range is the smallest and largest number of all.
"""
import argparse
import io
import json
import os
import tarfile

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper
from PIL import Image

from cpu_graph import Graph, quantised

SIZES = [(256, 256), (256, 256), (256, 256), (224, 288), (192, 320), (288, 224)]
CHOOSE = ("computer_mouse", "juice_box_table", "terrace", "wooden_sculpture", "blowtorch", "milk_carton")
NEIGHBORS = 3


def packed(images, lenses, poses, near, far):
    f32 = lambda a: np.ascontiguousarray(np.array(a, np.float32))
    n, c = len(images), np.array(poses)[:, :3, 3]
    apart = np.linalg.norm(c[:, None] - c[None], axis=2) + np.diag(np.full(n, np.inf))
    return {
        "images": f32(images), "intrinsics": f32(lenses), "camera_to_world": f32(poses),
        "near": np.full(n, near, np.float32), "far": np.full(n, far, np.float32),
        "neighbors": apart.argsort(1)[:, : min(n - 1, NEIGHBORS)],
    }


def planes(data, seed):
    """Three planes with photographs on them, one behind the other."""
    h, w = SIZES[seed % len(SIZES)]
    r = np.random.default_rng(seed)
    archive = tarfile.open(os.path.join(data, "images", ("bsds500.tar", "coco_unlabelled.tar")[seed % 2]))
    files = [m for m in archive.getmembers() if m.name.endswith(".jpg")]
    read = lambda m: Image.open(io.BytesIO(archive.extractfile(m).read())).convert("RGB").resize((512, 512))
    textures = [np.asarray(read(files[int(r.integers(len(files)))]), np.float32) / 255 for _ in range(3)]
    depths, fx = np.sort(r.uniform(3, 12, 3))[::-1], r.uniform(0.8, 1.4)
    lens = np.array([[fx, 0, 0.5], [0, fx * w / h, 0.5], [0, 0, 1]])
    away = r.standard_normal(3) * [1, 0.4, 0.2]
    poses = [np.eye(4), np.eye(4)]
    poses[1][:3, 3] = away / np.linalg.norm(away)
    gy, gx = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    rays = np.stack([(gx - 0.5) / lens[0, 0], (gy - 0.5) / lens[1, 1], np.ones_like(gx)], -1)
    images = []
    for pose in poses:
        image = np.zeros((h, w, 3), np.float32)
        for k, z in enumerate(depths):
            p = (pose[:3, 3] + rays * (z - pose[2, 3])) / z
            at = ((p[..., :2] * 0.8 + 0.5) * 511).astype(int)
            colours = textures[k][np.abs(at[..., 1]) % 512, np.abs(at[..., 0]) % 512]
            shown = np.ones((h, w), bool) if k == 0 else (np.abs(p[..., 0] - (-0.2, 0.2)[k - 1]) < 0.18) & (np.abs(p[..., 1] - 0.1 * k) < 0.2)
            image[shown] = colours[shown]
        images.append(image.transpose(2, 0, 1))
    return packed(images, [lens, lens], poses, depths[-1] * 0.7, depths[0] * 1.5)


def photos(data, scene, first, count):
    """Photos of a scene, one after the other."""
    folder = os.path.join(data, "scenes", scene)
    with open(os.path.join(folder, "transforms.json")) as file:
        top = json.load(file)
    frames = sorted(top["frames"], key=lambda f: f["file_path"])
    images, lenses, poses = [], [], []
    for frame in (frames[(first + k) % len(frames)] for k in range(count)):
        get = lambda key: frame.get(key, top.get(key, 0)) or 0
        photo = Image.open(os.path.join(folder, frame["file_path"])).convert("RGB")
        side = min(photo.size)
        x, y = (photo.size[0] - side) / 2, (photo.size[1] - side) / 2
        square = photo.resize((256, 256), Image.BILINEAR, box=(x, y, x + side, y + side))
        images.append(np.asarray(square, np.float32).transpose(2, 0, 1) / 255)
        lenses.append([[get("fl_x") / side, 0, (get("cx") - x) / side], [0, get("fl_y") / side, (get("cy") - y) / side], [0, 0, 1]])
        pose = np.array(frame["transform_matrix"], float)
        pose[:3, 1:3] *= -1
        poses.append(pose)
    poses = [np.linalg.inv(poses[0]) @ p for p in poses]
    c = np.array(poses)[:, :3, 3]
    baseline = np.linalg.norm(c[:, None] - c[None], axis=2).max()
    for p in poses:
        p[:3, 3] /= baseline
    return packed(images, lenses, poses, 1.5, 30)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--graph", required=True)
    ap.add_argument("--data", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--views", type=int, default=2, help="photos of a set")
    ap.add_argument("--planes", type=int, default=14, help="pairs of made pictures")
    ap.add_argument("--wider", help="ranges of earlier weights, that are at least taken")
    args = ap.parse_args()
    g = Graph(args.graph)
    names = list(dict.fromkeys(x for n, _ in quantised(g) for x in (n.input[0], n.output[0])))
    model = onnx.load(args.graph)
    model.graph.output.extend(helper.make_tensor_value_info(n, TensorProto.FLOAT, None) for n in names)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    inputs = [planes(args.data, seed) for seed in range(args.planes)]
    inputs += [photos(args.data, scene, 3 * k, args.views) for scene in CHOOSE for k in range(3)]
    ranges = {}
    if args.wider:
        with open(args.wider) as file:
            ranges = {name: found for name, found in json.load(file).items() if name in names}
    for each in inputs:
        for name, found in zip(names, session.run(names, each)):
            low, high = ranges.get(name, (0.0, 0.0))
            ranges[name] = min(low, float(found.min())), max(high, float(found.max()))
    with open(args.out, "w") as file:
        json.dump({n: [round(v, 4) for v in r] for n, r in ranges.items()}, file, indent=0)
        file.write("\n")


if __name__ == "__main__":
    main()
