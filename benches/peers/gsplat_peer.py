"""gsplat and `segsplat bench` on one GPU and one scene, in turn.

    python gsplat_peer.py SITE OUT SEGSPLAT [--gaussians N --width W --height H --rounds R ...]

SITE holds gsplat (see build_gsplat.py), OUT takes the raw figures (peers.jsonl). gsplat is timed by
CUDA events around what it is asked for, our renderer by its own timestamps around the same: neither
reads anything back."""

import argparse
import json
import pathlib
import statistics
import subprocess
import sys

parser = argparse.ArgumentParser()
parser.add_argument("site")
parser.add_argument("out", type=pathlib.Path)
parser.add_argument("segsplat")
parser.add_argument("--gaussians", type=int, default=5_896_178)
parser.add_argument("--width", type=int, default=1920)
parser.add_argument("--height", type=int, default=1080)
parser.add_argument("--rounds", type=int, default=3)
parser.add_argument("--frames", type=int, default=30)
parser.add_argument("--bank", type=int, default=24)
parser.add_argument("--features", type=int, default=512)
parser.add_argument("--texts", type=int, default=4, help="the query and the canonical phrases")
args = parser.parse_args()
sys.path.insert(0, args.site)

import torch  # noqa: E402
from gsplat import rasterization  # noqa: E402
from safetensors.torch import load_file  # noqa: E402

args.out.mkdir(parents=True, exist_ok=True)
scene_file = args.out / "scene.safetensors"
command = [
    args.segsplat, "bench", "--renderer", "gpu", "--gaussians", str(args.gaussians),
    "--size", str(args.height), "--width", str(args.width), "--frames", str(args.frames),
    "--labels", "blend", "--bank", str(args.bank), "--json",
]


def ours(*more):
    done = subprocess.run([*command, *more], check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


first = ours("--dump", str(scene_file))
scene = {name: tensor.cuda() for name, tensor in load_file(str(scene_file)).items()}
scene_file.unlink()
camera = scene["camera"].cpu()
viewmat = camera[:16].reshape(1, 4, 4).cuda()
fx, fy, cx, cy, width, height, near = camera[16:23].tolist()
intrinsics = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]]).cuda()
shared = dict(
    means=scene["means"], quats=scene["quats"], scales=scene["scales"],
    opacities=scene["opacities"], viewmats=viewmat, Ks=intrinsics, width=int(width),
    height=int(height), near_plane=near, radius_clip=0.0, eps2d=0.3,
)
one_hot = torch.nn.functional.one_hot(scene["index"].long(), args.bank + 1)[:, 1:].float()
torch.manual_seed(1)
bank = torch.nn.functional.normalize(torch.randn(args.bank, args.features), dim=1).cuda()
texts = torch.nn.functional.normalize(torch.randn(args.texts, args.features), dim=1).cuda()


def colour(packed):
    # Without a background, which gsplat 1.5.3 refuses for packed scenes.
    return rasterization(colors=scene["sh"], sh_degree=0, packed=packed, **shared)[:2]


def mask(packed):
    """The usual road: 24 blended channels, decoded, brought to unit length, compared."""
    weights = rasterization(colors=one_hot, packed=packed, **shared)[0][0]
    seen = torch.nn.functional.normalize(weights.reshape(-1, args.bank) @ bank, dim=1)
    cosines = seen @ texts.T
    scores = torch.sigmoid(10 * (cosines[:, :1] - cosines[:, 1:])).amin(1)
    return scores >= 0.5


def timed(work):
    times = []
    for i in range(args.frames + 3):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        work()
        end.record()
        end.synchronize()
        if i >= 3:
            times.append(start.elapsed_time(end))
    return statistics.median(times)


with torch.inference_mode():
    seen, alpha = (picture[0] for picture in colour(False))
    apart = (seen + (1 - alpha) * camera[23:26].cuda() - scene["color"]).abs()
    rows = []
    for turn in range(args.rounds):
        # The faster of gsplat's two layouts is taken for each.
        theirs = {
            "colour_ms": min(timed(lambda: colour(p)) for p in (False, True)),
            "mask_ms": min(timed(lambda: mask(p)) for p in (False, True)),
        }
        report = ours()
        row = {
            "round": turn,
            "gaussians": report["gaussians"],
            "width": report["width"],
            "height": report["size"],
            "gsplat": theirs,
            "segsplat": {
                "colour_ms": report["device"]["total_ms"],
                "mask_ms": report["labels"]["device"]["total_ms"],
                "stages": report["device"]["stages"],
                "mask_stages": report["labels"]["device"]["stages"],
            },
            "difference": {"max": apart.max().item(), "mean": apart.mean().item(),
                           "psnr_db": -10 * apart.double().square().mean().log10().item(),
                           "over_1_255": (apart.amax(-1) > 1 / 255).sum().item()},
        }
        rows.append(row)
        print(json.dumps({k: v for k, v in row.items()}), flush=True)
with open(args.out / "peers.jsonl", "a") as file:
    file.writelines(json.dumps(row) + "\n" for row in rows)
middle = lambda who, what: statistics.median(row[who][what] for row in rows)  # noqa: E731
for what in ("colour_ms", "mask_ms"):
    mine, theirs = middle("segsplat", what), middle("gsplat", what)
    print(f"{what}: segsplat {mine:.3f}, gsplat {theirs:.3f}, {theirs / mine:.2f} times")
