"""Holds a served scene to the official code: photos through the server, and the same photos through PyTorch.

    segsplat serve --bundle DIR --data-dir DATA --listen 127.0.0.1:8080 &
    python parity.py depthsplat --repo depthsplat --dinov2 dinov2 --random 0 --url http://127.0.0.1:8080 --data-dir DATA --scene SCENE

SCENE is a folder of photos with a `transforms.json`. Photos (the first and the one nearest to it) are cropped and
resized to the network's size before both sides get them, so that both see the same pixels; distortion is not undone.
The server makes the scene with `density=full`, and answers a view and a text. Each Gaussian that it kept is compared
with the official adapter's of the same pixel, in the world's frame: its mean, its covariance, its opacity and its
colour in 32 directions, each as a share of the largest value. With `--exact` the official code runs in f64 too, and
both are compared with that: how far f32 itself is off, and whether the server is further off than PyTorch. It takes
twice the memory and two to three times the time.
"""
import argparse
import glob
import io
import json
import os
import sys
import time
import urllib.error
import urllib.request

import numpy as np
import torch
from PIL import Image

sys.path.append(os.path.join(os.path.dirname(__file__), "../../scripts"))

import geometry
import official
from common import gap, prepare
from form import form

DIRECTIONS = 32
BOUNDS = {**geometry.BOUNDS, "colours": geometry.BOUNDS["harmonics"]}


def photos(args):
    """PNG files, their pixels `[V, 3, H, W]`, intrinsics by width and height, camera-to-world in OpenCV's axes."""
    with open(os.path.join(args.scene, "transforms.json")) as file:
        scene = json.load(file)
    frames = scene["frames"]
    poses = np.array([frame["transform_matrix"] for frame in frames]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    away = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    chosen = np.argsort(away)[: args.views]
    height, width = args.size
    files, pixels, lenses = [], [], []
    for i in chosen:
        lens = {**scene, **frames[i]}
        image = Image.open(os.path.join(args.scene, frames[i]["file_path"])).convert("RGB")
        w, h = image.size
        scale = min(w / width, h / height)
        x0, y0 = (w - width * scale) / 2, (h - height * scale) / 2
        image = image.resize((width, height), Image.LANCZOS, box=(x0, y0, x0 + width * scale, y0 + height * scale))
        png = io.BytesIO()
        image.save(png, "PNG")
        files.append(png.getvalue())
        pixels.append(np.asarray(image, np.float32).transpose(2, 0, 1) / 255)
        lenses.append({"fl_x": lens["fl_x"] / scale, "fl_y": lens["fl_y"] / scale, "cx": (lens["cx"] - x0) / scale, "cy": (lens["cy"] - y0) / scale})
    return files, torch.from_numpy(np.stack(pixels)), lenses, poses[chosen]


def call(url, body=None, content="application/json"):
    request = urllib.request.Request(url, body, {"content-type": content} if body else {})
    with urllib.request.urlopen(request, timeout=1800) as answer:
        return answer.read()


def served(args, files, lenses, poses):
    """The scene that the server makes; also a view and the answer to a text."""
    height, width = args.size
    frames = [{"file_path": f"{i}.png", "transform_matrix": (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(), **lens}
              for i, (pose, lens) in enumerate(zip(poses, lenses))]
    parts = [("transforms", "transforms.json", json.dumps({"w": width, "h": height, "frames": frames}).encode())]
    parts += [("photos", f"{i}.png", png) for i, png in enumerate(files)]
    body, kind = form(parts)
    begun = time.perf_counter()
    status = json.loads(call(f"{args.url}/v1/scenes?wait_ms=600000&density=full&semantics=lazy", body, kind))
    while status["state"] not in ("done", "failed"):
        time.sleep(1)
        status = json.loads(call(f"{args.url}/v1/scenes/{status['id']}"))
    print(f"scene {status['id']}: {status['state']} after {time.perf_counter() - begun:.1f} s; {status.get('error') or ''}")
    at = f"{args.url}/v1/scenes/{status['id']}"
    print(f"view: {len(call(f'{at}/view?from=0&to=1&t=0.5'))} bytes")
    if not args.no_text:
        begun = time.perf_counter()
        answer = None
        while answer is None:
            try:
                answer = json.loads(call(f"{at}/query", json.dumps({"texts": ["a chair"]}).encode()))
            except urllib.error.HTTPError as error:  # the semantics are being made
                if error.code != 409:
                    raise
                time.sleep(2)
        print(f"text: answered after {time.perf_counter() - begun:.1f} s: {str(answer)[:160]}")
    return status


def arrays(args, status):
    """The arrays of the scene's file."""
    from safetensors import safe_open

    found = [path for path in glob.glob(f"{args.data_dir}/**", recursive=True) if status["id"] in path and os.path.isfile(path)]
    for path in found:
        with open(path, "rb") as file:
            if b'"opacities"' not in file.read(4096):
                continue
        with safe_open(path, "np") as file:
            header = next(json.loads(value) for value in file.metadata().values() if '"origin"' in value)
            return {name: file.get_tensor(name) for name in file.keys()}, header
    raise SystemExit(f"no scene file among {found}")


def basis(d):
    """3DGS's harmonics of degree 0 to 3, `[N, 16]`."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack([
        0.28209479177387814 * np.ones_like(x), -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy), -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy), -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy)], 1)


def main():
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("network", choices=geometry.NETWORKS)
    for name in ("repo", "url", "data-dir", "scene"):
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--dinov2")
    ap.add_argument("--checkpoint")
    ap.add_argument("--random", type=int)
    ap.add_argument("--size", type=int, nargs=2, default=[256, 256])
    ap.add_argument("--views", type=int, default=2)
    ap.add_argument("--set", nargs="*", default=[])
    ap.add_argument("--near-content", type=float, default=geometry.NEAR_CONTENT, help="`near` of the bundle's translation")
    ap.add_argument("--exact", action="store_true", help="compare both with the official code in f64, too")
    ap.add_argument("--no-text", action="store_true")
    args = ap.parse_args()
    files, pixels, lenses, poses = photos(args)
    status = served(args, files, lenses, poses)
    ours, header = arrays(args, status)

    # The model frame: the first camera, and the unit that the manifest's rule gives.
    near = status["report"]["depth_range"][0] if "report" in status else header["meta"]["report"]["depth_range"][0]
    unit = near / args.near_content
    first = poses[0]
    model = np.linalg.inv(first) @ poses
    model[:, :3, 3] /= unit
    height, width = args.size
    lens = np.array([[[k["fl_x"] / width, 0, k["cx"] / width], [0, k["fl_y"] / height, k["cy"] / height], [0, 0, 1]] for k in lenses])
    known = geometry.NETWORKS[args.network]
    full = lambda value: torch.full((1, args.views), value)  # noqa: E731
    prepare(args)
    encoder = geometry.build(args.network, args)
    context = {"image": pixels[None], "intrinsics": torch.from_numpy(lens).float()[None], "extrinsics": torch.from_numpy(model).float()[None],
               "near": full(known["near"]), "far": full(known["far"])}
    wanted = official.gaussians(encoder, context)
    count = args.views * height * width

    # The official Gaussians of the pixels that the server kept, in the world.
    view, x, y = ours["source"].astype(np.int64).T
    kept = (view * height + y) * width + x
    rotation, camera = first[:3, :3], poses[view, :3, 3]
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    terms = ours["sh"].shape[1]

    def world(found):
        of = lambda value: value[0, -count:].double().numpy()[kept]  # noqa: E731
        return {"means": of(found.means) * unit @ rotation.T + first[:3, 3] - camera,
                "covariances": unit**2 * rotation @ of(found.covariances) @ rotation.T,
                "opacities": of(found.opacities), "colours": of(found.harmonics)[..., :terms] @ basis(directions)[:, :terms].T}

    theirs = world(wanted)
    mine = {"means": ours["means"].astype(np.float64) + np.array(header["origin"]) - camera,
            "covariances": official.covariance(torch.from_numpy(ours["scales"]).double(), torch.from_numpy(ours["quats"]).double()).numpy(),
            "opacities": ours["opacities"], "colours": ours["sh"].transpose(0, 2, 1) @ basis(directions @ rotation.T)[:, :terms].T}
    print(f"{len(kept)} of {count} Gaussians kept; dropped: {header['meta']['report']['dropped']}")
    row = {"kept": len(kept), **compared("the server to PyTorch", mine, theirs)}
    if args.exact:
        exact = world(official.gaussians(encoder, context, double=True))
        row["server_to_f64"] = compared("the server to PyTorch in f64", mine, exact)
        row["pytorch_to_f64"] = compared("PyTorch in f32 to PyTorch in f64", theirs, exact)
    print(json.dumps(row))


def compared(what, found, wanted):
    """Largest differences as shares of the largest value; of means also by their distance from the camera, and of its
    inverse, in which MVSplat looks for depths, as a share of its largest."""
    row = {name: gap(found[name], wanted[name]) for name in wanted}
    for name, value in row.items():
        print(f"{what}: {name} {value:.2e} of the largest value (bound {BOUNDS[name]:.0e})")
    near, far = (np.linalg.norm(side["means"], axis=1) for side in (found, wanted))
    off = np.linalg.norm(found["means"] - wanted["means"], axis=1) / far
    row["means_by_distance"] = {name: float(np.quantile(off, at)) for name, at in (("median", 0.5), ("p999", 0.999), ("largest", 1))}
    row["inverse_distances"] = gap(1 / near, 1 / far)
    print(f"{what}: means by their distance {row['means_by_distance']}, inverse distances {row['inverse_distances']:.1e}")
    return row


if __name__ == "__main__":
    main()
