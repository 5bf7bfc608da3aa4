"""gsplat and `segsplat-lab frames` on one GPU and one scene, in turn.

    python gsplat_peer.py SITE OUT LAB [--gaussians N --width W --height H --rounds R ...]

SITE holds gsplat (see build_gsplat.py), LAB is the program segsplat-lab, OUT takes one row.
Two comparisons, each of like with like. Call: the wall time from the call until the picture lies
in the host's memory, for both. Kernels: the sum of the kernels' own times by PyTorch's profiler
against the sum of our dispatches' times by the device's clock. gsplat blends a text's mask in two
ways: its usual one (24 channels, decoded, compared with the texts), and ours (four scalars a
Gaussian)."""

import argparse
import json
import pathlib
import statistics
import subprocess
import sys
import time

parser = argparse.ArgumentParser()
parser.add_argument("site")
parser.add_argument("out", type=pathlib.Path)
parser.add_argument("lab", nargs="+", help="segsplat-lab, or a program that answers as it does")
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
from torch.profiler import ProfilerActivity, profile  # noqa: E402

scene_file = args.out.with_suffix(".safetensors")
command = [
    *args.lab, "frames", "--renderer", "gpu", "--gaussians", str(args.gaussians),
    "--size", str(args.height), "--width", str(args.width), "--frames", str(args.frames),
    "--labels", "blend", "--bank", str(args.bank),
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
scalars = torch.rand(len(one_hot), 4).cuda()
bank = torch.nn.functional.normalize(torch.randn(args.bank, args.features), dim=1).cuda()
texts = torch.nn.functional.normalize(torch.randn(args.texts, args.features), dim=1).cuda()


def colour(packed):
    # Without a background, which gsplat 1.5.3 refuses for packed scenes.
    return rasterization(colors=scene["sh"], sh_degree=0, packed=packed, **shared)[:2]


def mask(packed):
    """gsplat's usual way: 24 blended channels, decoded, brought to unit length, compared."""
    weights = rasterization(colors=one_hot, packed=packed, **shared)[0][0]
    seen = torch.nn.functional.normalize(weights.reshape(-1, args.bank) @ bank, dim=1)
    cosines = seen @ texts.T
    scores = torch.sigmoid(10 * (cosines[:, :1] - cosines[:, 1:])).amin(1)
    return (scores >= 0.5,)


def mask_of_scalars(packed):
    """Our way: four scalars a Gaussian, blended."""
    return rasterization(colors=scalars, packed=packed, **shared)[:1]


def call_ms(work):
    times = []
    for i in range(args.frames + 3):
        begun = time.perf_counter()
        [picture.cpu() for picture in work()]
        times.append(1e3 * (time.perf_counter() - begun))
    return statistics.median(times[3:])


def kernel_ms(work):
    work()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as seen:
        for _ in range(args.frames):
            work()
        torch.cuda.synchronize()
    total = sum(event.self_device_time_total for event in seen.key_averages()
                if event.device_type == torch.autograd.DeviceType.CUDA)
    return 1e-3 * total / args.frames


def kernels_of(times):
    return sum(stage["ms"] for stage in times["stages"])


with torch.inference_mode():
    seen, alpha = (picture[0] for picture in colour(False))
    apart = (seen + (1 - alpha) * camera[23:26].cuda() - scene["color"]).abs()
    found = {}
    for turn in range(args.rounds):
        # The faster of gsplat's two layouts is taken for each.
        for name, work in (("colour", colour), ("mask_24", mask), ("mask_4", mask_of_scalars)):
            for what, measure in (("call_ms", call_ms), ("kernels_ms", kernel_ms)):
                best = min(measure(lambda: work(packed)) for packed in (False, True))
                found.setdefault(f"gsplat {name} {what}", []).append(best)
        report = ours()
        labels = report["labels"]
        for name, value in (
            ("colour call_ms", labels["color_ms"]), ("mask call_ms", labels["labels_ms"]),
            ("colour kernels_ms", kernels_of(report["device"])),
            ("mask kernels_ms", kernels_of(labels["device"])),
            ("colour device_ms", report["device"]["total_ms"]),
            ("mask device_ms", labels["device"]["total_ms"]),
        ):
            found.setdefault(f"segsplat {name}", []).append(value)
row = {
    **{key: first[key] for key in ("commit", "machine", "hashes", "gaussians", "width", "height")},
    "table": "gsplat",
    "command": f"gsplat_peer.py SITE OUT LAB --gaussians {args.gaussians} --width {args.width} "
               f"--height {args.height} --frames {args.frames} --rounds {args.rounds}",
    "gsplat_version": "1.5.3", "torch": torch.__version__, "rounds": args.rounds,
    "error": {"max": apart.max().item(), "mean": apart.mean().item(),
              "psnr_db": -10 * apart.double().square().mean().log10().item(),
              "over_1_255": (apart.amax(-1) > 1 / 255).sum().item()},
    **{who: {key.split(" ", 1)[1].replace(" ", "_"): statistics.median(values)
             for key, values in found.items() if key.startswith(who)}
       for who in ("segsplat", "gsplat")},
}
with open(args.out, "a") as file:
    file.write(json.dumps(row) + "\n")
print(json.dumps(row))
