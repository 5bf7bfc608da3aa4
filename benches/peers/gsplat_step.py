"""Forward and backward of gsplat and of `segsplat-lab backward` on one GPU and one scene, in turn.

    python gsplat_step.py SITE OUT LAB [--gaussians N --width W --height H --rounds R ...]

SITE holds gsplat (see build_gsplat.py), LAB is the program segsplat-lab, OUT takes one row. The
loss is linear in colour, with the same random numbers for both. Step: the wall time of forward and
backward. gsplat's Gaussians, pictures and gradients stay on the GPU; ours go up and down. Trained:
a step of our refinement, where all stays there too, with its loss and Adam. Kernels: the sum of the
kernels' own times by PyTorch's profiler against the sum of our dispatches' times by the device's
clock. The error is that of our gradients to gsplat's."""

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
parser.add_argument("--gaussians", type=int, default=500_000)
parser.add_argument("--width", type=int, default=640)
parser.add_argument("--height", type=int, default=480)
parser.add_argument("--rounds", type=int, default=3)
parser.add_argument("--frames", type=int, default=30)
args = parser.parse_args()
sys.path.insert(0, args.site)

import torch  # noqa: E402
from gsplat import rasterization  # noqa: E402
from safetensors.torch import load_file  # noqa: E402
from torch.profiler import ProfilerActivity, profile  # noqa: E402

scene_file = args.out.with_suffix(".safetensors")
command = [
    *args.lab, "backward", "--renderer", "gpu", "--gaussians", str(args.gaussians),
    "--size", str(args.height), "--width", str(args.width), "--frames", str(args.frames),
    "--compare", "cpu",
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
background = camera[23:26].cuda()
kinds = ("means", "quats", "scales", "opacities", "sh")
numbers = {kind: scene[kind].clone().requires_grad_() for kind in kinds}
by_color = scene["by_color"].reshape(1, int(height), int(width), 3)


def forward(packed):
    colour, alpha, _ = rasterization(
        means=numbers["means"], quats=numbers["quats"], scales=numbers["scales"],
        opacities=numbers["opacities"], colors=numbers["sh"], sh_degree=0, viewmats=viewmat,
        Ks=intrinsics, width=int(width), height=int(height), near_plane=near, radius_clip=0.0,
        eps2d=0.3, packed=packed,
    )
    return colour + (1 - alpha) * background


def step(packed):
    for number in numbers.values():
        number.grad = None
    forward(packed).backward(by_color)


def step_ms(work, packed):
    times = []
    for _ in range(args.frames + 3):
        torch.cuda.synchronize()
        begun = time.perf_counter()
        work(packed)
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - begun))
    return statistics.median(times[3:])


def kernel_ms(work, packed):
    work(packed)
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as seen:
        for _ in range(args.frames):
            work(packed)
        torch.cuda.synchronize()
    total = sum(event.self_device_time_total for event in seen.key_averages()
                if event.device_type == torch.autograd.DeviceType.CUDA)
    return 1e-3 * total / args.frames


def apart():
    """Median relative error of each kind, of the numbers over a millionth of the largest."""
    found = {}
    for kind in kinds:
        want = numbers[kind].grad.reshape(-1).double()
        got = scene[f"by_{kind}"].reshape(-1).double()
        counts = want.abs() > 1e-6 * want.abs().max()
        errors = ((got - want).abs() / want.abs())[counts]
        found[kind] = {"median": errors.median().item(), "p99": errors.quantile(0.99).item()
                       if len(errors) < 1 << 24 else None, "numbers": len(errors)}
    return found


step(False)
errors = apart()
found, last = {}, first
for _ in range(args.rounds):
    for name, measure in (("step_ms", step_ms), ("kernels_ms", kernel_ms)):
        # The faster of gsplat's two layouts is taken.
        best = min(measure(step, packed) for packed in (False, True))
        found.setdefault(f"gsplat {name}", []).append(best)
    best = min(step_ms(forward, packed) for packed in (False, True))
    found.setdefault("gsplat forward_ms", []).append(best)
    last = ours()
    stages = last["device"]["stages"]
    for name, value in (
        *((key, last[key]) for key in ("step_ms", "trained_ms", "forward_ms")),
        ("device_ms", last["device"]["total_ms"]),
        ("kernels_ms", sum(stage["ms"] for stage in stages)),
    ):
        found.setdefault(f"segsplat {name}", []).append(value)
row = {
    **{key: first[key] for key in ("commit", "machine", "hashes", "gaussians", "width", "height",
                                   "visible", "intersections")},
    "table": "gsplat-step",
    "command": f"gsplat_step.py SITE OUT LAB --gaussians {args.gaussians} --width {args.width} "
               f"--height {args.height} --frames {args.frames} --rounds {args.rounds}",
    "gsplat_version": "1.5.3", "torch": torch.__version__, "rounds": args.rounds,
    "error": {"to_cpu_kernel": first["error"], "to_gsplat": errors},
    "stages": last["device"]["stages"],
    **{who: {key.split(" ", 1)[1]: statistics.median(values)
             for key, values in found.items() if key.startswith(who)}
       for who in ("segsplat", "gsplat")},
}
with open(args.out, "a") as file:
    file.write(json.dumps(row) + "\n")
print(json.dumps(row))
