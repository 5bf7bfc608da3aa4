"""RealEstate10K as DepthSplat and the paper evaluate it: two photos in, views between them out.

    python re10k.py SEGSPLAT DATA INDEX OUT [--bundle DIR --provider cuda --count N --lpips FILE]

DATA is the folder `test` of pixelSplat's conversion: `*.torch`, each a list of sequences, and
`index.json` (sequence to file). INDEX is DepthSplat's `assets/evaluation_index_re10k.json`:
sequence to `context` and `target` frames. Photos are resized by Lanczos and cropped to 256 x
256 as there. One server makes all scenes, with `preset=paper`, and draws all target views of a
scene in one call. PSNR, SSIM as scikit-image counts it (Gaussian weights, window 11), and LPIPS
where `--lpips` names a file of `models/export/perceptual.py`. OUT takes a row a sequence and
their mean; `segsplat-lab report --beside paper-views=OUT` prints it below the paper's rows.

Needs numpy, pillow, scipy."""

import argparse
import io
import json
import pathlib
import statistics
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
import zipfile

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

from torchfile import load

ROOT = pathlib.Path(__file__).parents[2]
sys.path += [str(ROOT / "scripts"), str(ROOT / "tests/tools")]
from form import form  # noqa: E402
from served import served  # noqa: E402

SIDE = 256
# Views of one call.
CAMERAS = 32


class Sequence:
    """The frames of a sequence: pictures of SIDE x SIDE, and cameras in OpenCV axes."""

    def __init__(self, example):
        self.images, self.cameras = example["images"], np.asarray(example["cameras"], np.float64)

    def picture(self, at):
        """`[SIDE, SIDE, 3]` u8: covered by the resized photo, the middle kept."""
        photo = Image.open(io.BytesIO(np.ascontiguousarray(self.images[at]).tobytes())).convert(
            "RGB"
        )
        scale = max(SIDE / photo.width, SIDE / photo.height)
        width, height = round(photo.width * scale), round(photo.height * scale)
        x, y = (width - SIDE) // 2, (height - SIDE) // 2
        return np.array(photo.resize((width, height), Image.LANCZOS))[y : y + SIDE, x : x + SIDE]

    def camera(self, at):
        """Pixels of the picture, and the pose camera to world, row-major."""
        fx, fy, cx, cy, _, _, *pose = self.cameras[at]
        width, height = Image.open(io.BytesIO(np.ascontiguousarray(self.images[at]).tobytes())).size
        scale = max(SIDE / width, SIDE / height)
        width, height = round(width * scale), round(height * scale)
        world_to_camera = np.vstack([np.reshape(pose, (3, 4)), [0, 0, 0, 1]])
        lens = {
            "fx": fx * width,
            "fy": fy * height,
            "cx": cx * width - (width - SIDE) // 2,
            "cy": cy * height - (height - SIDE) // 2,
        }
        return lens, [float(v) for v in np.linalg.inv(world_to_camera).ravel()]


def sequences(data, index):
    """Name, frames, context and target of each sequence of the index that the data hold."""
    files = json.loads((data / "index.json").read_text())
    wanted = {}
    for key, views in index.items():
        if views is not None and key in files:
            wanted.setdefault(files[key], {})[key] = views
    for file, keys in sorted(wanted.items()):
        for example in load(data / file):
            if example["key"] in keys:
                views = keys[example["key"]]
                yield example["key"], Sequence(example), views["context"], views["target"]


def psnr(a, b):
    """Of pictures in 0..1."""
    return float(-10 * np.log10(max(((a - b) ** 2).mean(), 1e-12)))


def ssim(a, b):
    """`structural_similarity` of scikit-image with `win_size=11` and `gaussian_weights=True`."""
    window, pad = 11, 5
    unbiased = window**2 / (window**2 - 1)

    def blurred(x):
        return gaussian_filter(x, 1.5, truncate=3.5, axes=(0, 1))

    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    ua, ub = blurred(a), blurred(b)
    va, vb = unbiased * (blurred(a * a) - ua * ua), unbiased * (blurred(b * b) - ub * ub)
    vab = unbiased * (blurred(a * b) - ua * ub)
    c1, c2 = 0.01**2, 0.03**2
    found = (2 * ua * ub + c1) * (2 * vab + c2) / ((ua**2 + ub**2 + c1) * (va + vb + c2))
    return float(found[pad:-pad, pad:-pad].mean())


def call(url, body=None, content="application/json", method=None):
    request = urllib.request.Request(url, body, {"content-type": content}, method=method)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        raise SystemExit(f"{url}: {error.read().decode()}") from None


def png(picture):
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def judged(url, perceptual, name, frames, context, targets):
    """The row of one sequence."""
    cameras, photos = [], []
    for at in context:
        lens, pose = frames.camera(at)
        photos.append(("photo", f"{at:05}.png", png(frames.picture(at))))
        lens |= {"width": SIDE, "height": SIDE}
        cameras.append({"file": f"{at:05}.png", "intrinsics": lens, "camera_to_world": pose})
    told = json.dumps({"cameras": cameras}).encode()
    body, content = form([("cameras", "cameras.json", told), *photos])
    ask = "preset=paper&semantics=off&refine=off&wait_ms=600000"
    scene = json.loads(call(f"{url}/v1/scenes?{ask}", body, content))
    if scene["state"] != "done":
        raise SystemExit(f"{name}: {scene['error']}")
    scene_url = f"{url}/v1/scenes/{scene['id']}"
    figures = []
    for first in range(0, len(targets), CAMERAS):
        some = targets[first : first + CAMERAS]
        views = [frames.camera(at) for at in some]
        views = [{**lens, "camera_to_world": pose} for lens, pose in views]
        ask = {"cameras": views, "width": SIDE, "height": SIDE, "format": "png", "container": "zip"}
        answer = call(f"{scene_url}/views", json.dumps(ask).encode())
        with zipfile.ZipFile(io.BytesIO(answer)) as archive:
            drawn = [archive.read(one) for one in archive.namelist() if one.endswith(".png")]
        assert len(drawn) == len(some), f"{name}: {len(drawn)} of {len(some)} views"
        for at, view in zip(some, drawn):
            truth = frames.picture(at) / 255
            view = np.array(Image.open(io.BytesIO(view)).convert("RGB")) / 255
            figures.append({"psnr": psnr(truth, view), "ssim": ssim(truth, view)})
            if perceptual:
                figures[-1]["lpips"] = perceptual(truth, view)
    call(scene_url, method="DELETE")
    means = {key: statistics.fmean(row[key] for row in figures) for key in figures[0]}
    return {
        "sequence": name,
        "views": len(figures),
        "gaussians": scene["report"]["gaussians"],
        "provider": scene["report"]["execution_provider"],
        **means,
    }


def lpips(file):
    import onnxruntime

    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])

    def distance(a, b):
        names = [given.name for given in session.get_inputs()]
        feed = {
            name: (2 * x - 1).transpose(2, 0, 1)[None].astype(np.float32)
            for name, x in zip(names, (a, b))
        }
        return float(np.ravel(session.run(None, feed)[0])[0])

    return distance


def networks(bundle):
    """Where the geometry of a bundle comes from, as its manifest says."""
    return tomllib.loads((pathlib.Path(bundle) / "bundle.toml").read_text())["geometry"]["source"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("segsplat", type=pathlib.Path)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("index", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bundle", default="models/embedded")
    parser.add_argument("--provider", default="auto", help="of the server's networks")
    parser.add_argument("--count", type=int, help="sequences, the first ones [default: all]")
    parser.add_argument("--lpips")
    parser.add_argument("--machine", default="this machine")
    parser.add_argument("--commit", default="")
    args = parser.parse_args()
    perceptual, rows = lpips(args.lpips) if args.lpips else None, []
    with tempfile.TemporaryDirectory() as place:
        flags = ["--bundle", pathlib.Path(args.bundle).absolute(), "--provider", args.provider]
        program, data = args.segsplat.absolute(), pathlib.Path(place) / "data"
        with served(data, *flags, program=program) as url:
            for sequence in sequences(args.data, json.loads(args.index.read_text())):
                if len(rows) == args.count:
                    break
                rows.append(judged(url, perceptual, *sequence))
                print(json.dumps(rows[-1]), flush=True)
    if not rows:
        raise SystemExit(f"{args.data} holds no sequence of {args.index}")
    keys = [key for key in ("psnr", "ssim", "lpips") if key in rows[0]]
    means = {key: statistics.fmean(row[key] for row in rows) for key in keys}
    rows.append({"sequence": "mean", "sequences": len(rows), "unix_s": int(time.time()), **means})
    about = {"command": "re10k.py", "commit": args.commit, "machine": args.machine}
    about["networks"] = networks(args.bundle)
    with args.out.open("a") as file:
        file.writelines(json.dumps({**about, **row}) + "\n" for row in rows)
    print(f"{'ours':24}", *(f"{key} {value:.4f}" for key, value in means.items()))


if __name__ == "__main__":
    main()
