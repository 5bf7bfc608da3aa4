"""3D Gaussian splatting from nothing by gsplat, on the photos of `segsplat-lab many`.

    python gsplat_scratch.py SITE OUT.jsonl SCENES --scenes fox,coke_can --photos 20 --seconds 1,5

SITE holds gsplat (see build_gsplat.py), SCENES is a folder of folders with a `transforms.json`.
Every sixth photo from the fourth is a target, PHOTOS of the others are given, spread evenly. It
starts from 50,000 random points with the rates, the loss (0.8 L1 + 0.2 (1 - SSIM)) and the default
strategy of gsplat's own `simple_trainer.py`; rates fall over the time that is given. Loading and
judging take no part of it. OUT takes a row of the table `scratch` for each scene and time: PSNR at
the targets, in dB, the mean of whole photos. Needs torch, numpy, opencv."""

import argparse
import json
import pathlib
import sys
import time

TARGET_EVERY, TARGET_FIRST = 6, 3
POINTS = 50_000
# Share of its first rate that a centre's rate has at the end.
LAST_RATE = 0.01
# Steps after which the next degree of harmonics is learnt, and the last degree.
DEGREE_EVERY, DEGREE = 1_000, 3
WINDOW, SIGMA = 11, 1.5

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("site")
parser.add_argument("out", type=pathlib.Path)
parser.add_argument("folder", type=pathlib.Path)
parser.add_argument("--scenes", required=True)
parser.add_argument("--photos", type=int, default=20)
parser.add_argument("--seconds", default="5")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--machine", default="one NVIDIA H200, 16 cores")
parser.add_argument("--hashes", type=json.loads, default={}, help="of `report --hashes`")
parser.add_argument("--commit", default="")
args = parser.parse_args()
sys.path.insert(0, args.site)

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
import torch.nn.functional as F  # noqa: E402
from gsplat import DefaultStrategy, rasterization  # noqa: E402

device = torch.device("cuda")


class View:
    """A photo without its lens distortion: `rgb [H, W, 3]` 0..1, `valid [H, W]`, `K`, pose."""

    def __init__(self, folder, lens, frame):
        at = {**lens, **frame}
        photo = cv2.imread(str(folder / at["file_path"]))[:, :, ::-1].copy()
        height, width = photo.shape[:2]
        k = np.array([[at["fl_x"], 0, at["cx"]], [0, at["fl_y"], at["cy"]], [0, 0, 1]])
        # OpenCV counts pixels from their centres.
        centred = k.copy()
        centred[:2, 2] -= 0.5
        bent = np.array([at.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")])
        valid = np.full((height, width), 255, np.uint8)
        if np.any(bent != 0):
            size = (width, height)
            maps = cv2.initUndistortRectifyMap(centred, bent, None, centred, size, cv2.CV_32FC1)
            photo = cv2.remap(photo, *maps, cv2.INTER_LINEAR)
            valid = cv2.remap(valid, *maps, cv2.INTER_LINEAR)
        pose = np.array(at["transform_matrix"], dtype=np.float64)
        pose[:3, 1:3] *= -1
        self.pose = pose
        self.rgb = torch.from_numpy(photo).to(device).float() / 255
        self.valid = torch.from_numpy(valid).to(device) == 255
        self.k = torch.from_numpy(k).to(device).float()

    def place(self, centre):
        pose = self.pose.copy()
        pose[:3, 3] -= centre
        self.pose = pose
        self.view = torch.from_numpy(np.linalg.inv(pose)).to(device).float()


def load(folder):
    """Targets and the photos that are given."""
    lens = json.loads((folder / "transforms.json").read_text())
    frames = lens["frames"]
    targets = [i for i in range(len(frames)) if i % TARGET_EVERY == TARGET_FIRST]
    rest = [i for i in range(len(frames)) if i % TARGET_EVERY != TARGET_FIRST]
    count = min(args.photos, len(rest))
    given = [rest[k * (len(rest) - 1) // (count - 1)] for k in range(count)]
    targets, given = ([View(folder, lens, frames[i]) for i in some] for some in (targets, given))
    centre = np.mean([view.pose[:3, 3] for view in given], axis=0)
    for view in targets + given:
        view.place(centre)
    extent = 1.1 * max(np.linalg.norm(view.pose[:3, 3]) for view in given)
    return targets, given, extent


def start(extent):
    """Random points in the cube of three extents, as `simple_trainer.py` has them, and Adam."""
    points = 3 * extent * (torch.rand(POINTS, 3, device=device) * 2 - 1)
    near = [torch.cdist(some, points).topk(4, largest=False) for some in points.split(2_000)]
    near = torch.cat([found.values[:, 1:] for found in near])
    colours = (torch.rand(POINTS, 1, 3, device=device) - 0.5) / 0.28209479177387814
    numbers = {
        "means": (points, 1.6e-4 * extent),
        "scales": (near.square().mean(1).sqrt().log()[:, None].repeat(1, 3), 5e-3),
        "quats": (torch.rand(POINTS, 4, device=device), 1e-3),
        "opacities": (torch.logit(torch.full((POINTS,), 0.1, device=device)), 5e-2),
        "sh0": (colours, 2.5e-3),
        "shN": (torch.zeros(POINTS, (DEGREE + 1) ** 2 - 1, 3, device=device), 2.5e-3 / 20),
    }
    learnt = {name: torch.nn.Parameter(value) for name, (value, _) in numbers.items()}
    scene = torch.nn.ParameterDict(learnt)
    steps = {
        name: torch.optim.Adam([scene[name]], rate, eps=1e-15, fused=True)
        for name, (_, rate) in numbers.items()
    }
    return scene, steps, numbers["means"][1]


def draw(scene, view, degree):
    height, width = view.rgb.shape[:2]
    colours = torch.cat([scene["sh0"], scene["shN"]], 1)
    image, _, info = rasterization(
        scene["means"], scene["quats"], scene["scales"].exp(), scene["opacities"].sigmoid(),
        colours, view.view[None], view.k[None], width, height, sh_degree=degree, packed=False,
    )
    return image[0], info


line = torch.exp(-((torch.arange(WINDOW, device=device) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
window = (line[:, None] * line / line.sum() ** 2).expand(3, 1, WINDOW, WINDOW).contiguous()


def ssim(x, y):
    """Mean over the windows that lie inside."""
    blur = lambda z: F.conv2d(z, window, groups=3)  # noqa: E731
    x, y = (z.permute(2, 0, 1)[None] for z in (x, y))
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    over = (2 * mx * my + c1) * (2 * vxy + c2)
    return (over / ((mx * mx + my * my + c1) * (vx + vy + c2))).mean()


@torch.no_grad()
def judge(scene, targets, degree):
    found = []
    for view in targets:
        error = (draw(scene, view, degree)[0].clamp(0, 1) - view.rgb)[view.valid]
        found.append(-10 * float(torch.log10(error.square().mean())))
    return sum(found) / len(found)


def trained(targets, given, extent, seconds):
    torch.manual_seed(args.seed)
    scene, optimisers, rate = start(extent)
    strategy = DefaultStrategy(verbose=False)
    state = strategy.initialize_state(scene_scale=extent)
    draw(scene, given[0], 0)  # compiles
    torch.cuda.synchronize()
    order, step, begun = [], 0, time.perf_counter()
    while (spent := (time.perf_counter() - begun) / seconds) < 1:
        order = order or torch.randperm(len(given)).tolist()
        view, degree = given[order.pop()], min(step // DEGREE_EVERY, DEGREE)
        optimisers["means"].param_groups[0]["lr"] = rate * LAST_RATE**spent
        image, info = draw(scene, view, degree)
        strategy.step_pre_backward(scene, optimisers, state, step, info)
        image = torch.where(view.valid[..., None], image, view.rgb)
        loss = 0.8 * (image - view.rgb).abs().mean() + 0.2 * (1 - ssim(image, view.rgb))
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        strategy.step_post_backward(scene, optimisers, state, step, info, packed=False)
        step += 1
        torch.cuda.synchronize()
    return judge(scene, targets, min(step // DEGREE_EVERY, DEGREE)), step, len(scene["means"])


for at, name in enumerate(args.scenes.split(",")):
    targets, given, extent = load(args.folder / name)
    if at == 0:
        trained(targets, given, extent, 1.0)  # libraries choose their algorithms
    for seconds in map(float, args.seconds.split(",")):
        psnr, steps, count = trained(targets, given, extent, seconds)
        row = {
            "table": "scratch",
            "command": "benches/peers/gsplat_scratch.py SITE OUT SCENES",
            "hashes": args.hashes,
            "commit": args.commit,
            "machine": args.machine,
            "unix_s": int(time.time()),
            "scene": name,
            "photos": len(given),
            "targets": len(targets),
            "asked_s": seconds,
            "steps": steps,
            "gaussians": count,
            "psnr": psnr,
            "error": {"psnr_db": psnr},
        }
        print(json.dumps(row), flush=True)
        with args.out.open("a") as out:
            out.write(json.dumps(row) + "\n")
