"""PSNR on real photographs that are never trained on: the shared scenes and the held-out captures.

The figure that counts is `segsplat-lab photos`, through the shipped ONNX and the product's
renderer; this is the same protocol in PyTorch for the log of a run: squares of 256 pixels, two
photos and a target between them, more photos nearest to the target, and the target once more at
twice the pixels (`x2`), where Gaussians that are too small show as dots.
"""
import json
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from splats import nearest_views, render, ssim, with_inputs
from sweep import Ranges, gray

SIDE = 256
REPORTED = ("fox", "red_kitchen", "duck_toy", "coke_can")
VIEWS = (2, 4, 8)
HELD_OUT_MOST = 12  # triples of a held-out capture


def undistorted(x, K, dist):
    k1, k2, p1, p2 = dist
    h, w = x.shape[-2:]
    v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    a, b = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    r = a * a + b * b
    d = 1 + k1 * r + k2 * r * r
    xd = a * d + 2 * p1 * a * b + p2 * (r + 2 * a * a)
    yd = b * d + p1 * (r + 2 * b * b) + 2 * p2 * a * b
    grid = torch.stack([(xd * K[0, 0] + K[0, 2]) / w * 2 - 1, (yd * K[1, 1] + K[1, 2]) / h * 2 - 1], -1)[None].float()
    return F.grid_sample(x, grid, mode="bilinear", padding_mode="border", align_corners=False)


def frames_of(folder):
    """(file, K in pixels, distortion, OpenCV camera-to-world) of a shared scene or of a capture."""
    if os.path.exists(os.path.join(folder, "cameras.json")):
        with open(os.path.join(folder, "cameras.json")) as file:
            for f in json.load(file)["frames"]:
                yield f["file"], np.array(f["K"]), [0.0] * 4, np.array(f["c2w"])
        return
    with open(os.path.join(folder, "transforms.json")) as file:
        top = json.load(file)
    for f in top["frames"]:
        get = lambda k: f.get(k, top.get(k, 0)) or 0
        K = np.array([[get("fl_x"), 0, get("cx")], [0, get("fl_y"), get("cy")], [0, 0, 1]])
        m = np.array(f["transform_matrix"], float)
        m[:3, 1:3] *= -1
        yield f["file_path"], K, [get(k) for k in ("k1", "k2", "p1", "p2")], m


def square(folder, file, K, dist):
    """The undistorted middle at 256 and 512 pixels, [3,side,side] bytes, and its K normalised."""
    x = torch.from_numpy(np.array(Image.open(os.path.join(folder, file)).convert("RGB"))).permute(2, 0, 1)[None].float()
    if any(dist):
        x = undistorted(x, K, dist)
    h, w = x.shape[-2:]
    s = min(w, h)
    x0, y0 = (w - s) // 2, (h - s) // 2
    pil = Image.fromarray(x[0, :, y0 : y0 + s, x0 : x0 + s].permute(1, 2, 0).round().clamp(0, 255).byte().numpy())
    pics = []
    for side in (SIDE, 2 * SIDE):
        resized = pil.resize((side, side), Image.BOX if s % side == 0 else Image.BICUBIC)
        pics.append(torch.from_numpy(np.array(resized)).permute(2, 0, 1))
    return *pics, np.array([[K[0, 0] / s, 0, (K[0, 2] - x0) / s], [0, K[1, 1] / s, (K[1, 2] - y0) / s], [0, 0, 1]])


class Scene:
    """Undistorted squares at 256 and 512 pixels; K normalised, poses in f64, OpenCV."""

    def __init__(self, folder, device):
        frames = list(frames_of(folder))
        with ThreadPoolExecutor(8) as pool:
            squares = list(pool.map(lambda f: square(folder, *f[:3]), frames))
        self.small, self.large = [[s[n].to(device) for s in squares] for n in range(2)]
        self.K = torch.tensor(np.stack([s[2] for s in squares]), dtype=torch.float64)
        self.c2w = torch.tensor(np.stack([f[3] for f in frames]), dtype=torch.float64)
        self.ranges = Ranges([gray(x.float() / 255) for x in self.small], self.K, self.c2w)

    def triples(self):
        """Two inputs and the photo between them, by the product's rule."""
        P = self.c2w
        c, ax = P[:, :3, 3], P[:, :3, 2]
        d = torch.cdist(c, c) + torch.eye(len(P)) * 1e9
        scale = float(d.min(1).values.median()) / 0.30
        ang = torch.rad2deg(torch.arccos((ax @ ax.T).clamp(-1, 1)))
        for i in range(len(P)):
            for j in range(i + 1, len(P)):
                b = (c[i] - c[j]).norm()
                if not (0.25 * scale <= b <= 1.3 * scale) or ang[i, j] >= 22:
                    continue
                away = (c - (c[i] + c[j]) / 2).norm(dim=1)
                away[[i, j]] = 1e9
                k = int(away.argmin())
                if away[k] < 0.45 * b and ang[i, k] < 20:
                    yield i, j, k

    def near_far(self, views):
        """Of each view, world units: quantiles of its matches with the others, with a margin."""
        base = float(torch.cdist(self.c2w[views, :3, 3], self.c2w[views, :3, 3]).max())
        # Few partners: eight photos have 56 pairs.
        order = lambda a: sorted((b for b in views if b != a), key=lambda b: float((self.c2w[a, :3, 3] - self.c2w[b, :3, 3]).norm()))[:3]
        found = [self.ranges.bounds(a, order(a)) for a in views]
        known = [f for f in found if f] or [(0.01 / base, 1 / base)]
        lo = [f[0] if f else min(k[0] for k in known) for f in found]
        hi = [f[1] if f else max(k[1] for k in known) for f in found]
        span = [max(h - l, 0.05 * h) for l, h in zip(lo, hi)]
        hi = [h + 0.15 * s for h, s in zip(hi, span)]
        lo = [max(l - 0.15 * s, 1e-3 / base) for l, s in zip(lo, span)]
        return 1 / torch.tensor(hi), 1 / torch.tensor(lo)


class Judge:
    def __init__(self, scenes, captures, device, views=VIEWS, input_side=SIDE):
        """scenes: folder of the shared scenes; captures: folders held out; views: photos of a set;
        input_side: side that the photos of 256 pixels are brought to for the network."""
        self.device, self.input_side, self.scenes, self.items = device, input_side, {}, []
        folders = [(n, os.path.join(scenes, n), "report" if n in REPORTED else "choose") for n in sorted(os.listdir(scenes))]
        folders += [(os.path.basename(f), f, "held_out") for f in captures]
        for name, folder, use in folders:
            scene = self.scenes[name] = Scene(folder, device)
            rows = list(scene.triples())
            if use == "held_out":
                rows = rows[:: -(-len(rows) // HELD_OUT_MOST)] if rows else []
            for i, j, k in rows:
                order = (scene.c2w[:, :3, 3] - scene.c2w[k, :3, 3]).norm(dim=1).argsort().tolist()
                more = [x for x in order if x not in (i, j, k)]
                sets = [[i, j, *more[: v - 2]] for v in views if len(more) >= v - 2]
                self.items.append((use, name, sets, k))

    def figures(self, net, every=1):
        """{use: {views: [dB, SSIM, dB at twice the pixels]}} and the same by scene; means of triples."""
        by_use, by_scene = {}, {}
        for use, name, sets, target in self.items[::every]:
            for views in sets:
                got = self.one(net, self.scenes[name], views, target)
                by_use.setdefault(f"{use}/{len(views)}", []).append(got)
                by_scene.setdefault(f"{name}/{len(views)}", []).append(got)
        mean = lambda rows: [round(float(np.mean([r[i] for r in rows])), 3) for i in range(3)] + [len(rows)]
        return {k: mean(v) for k, v in sorted(by_use.items())}, {k: mean(v) for k, v in sorted(by_scene.items())}

    def sheet(self, net, path):
        """A picture of one triple of each scene: target and view from two photos at 512 pixels."""
        rows, done = [], set()
        for _, name, sets, target in self.items:
            if name not in done:
                done.add(name)
                _, pics, want = self.one(net, self.scenes[name], sets[0], target, pictures=True)
                rows.append(torch.cat([want[1], pics[1].float()], 2).cpu())
        sheet = torch.cat([torch.cat(rows[i : i + 2], 2) for i in range(0, len(rows) - 1, 2)], 1)
        Image.fromarray((sheet * 255).byte().permute(1, 2, 0).numpy()).save(path, quality=88)

    @torch.no_grad()
    def one(self, net, scene, views, target, pictures=False):
        first = torch.linalg.inv(scene.c2w[views[0]])
        c2w, tgt = first @ scene.c2w[views], first @ scene.c2w[[target]]
        s = torch.cdist(c2w[:, :3, 3], c2w[:, :3, 3]).max()
        c2w[:, :3, 3] /= s
        tgt[:, :3, 3] /= s
        put = lambda x: x.float().to(self.device)[None]
        near, far = scene.near_far(views)
        c2w, tgt, K, Kt = put(c2w), put(tgt), put(scene.K[views]), put(scene.K[[target]])
        img = torch.stack([scene.small[v] for v in views]).float() / 255
        img = F.interpolate(img, (self.input_side, self.input_side), mode="bilinear", align_corners=False)[None]
        nb = nearest_views(c2w, min(len(views) - 1, 3))
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            out = net(img, K, c2w, put(near / s), put(far / s), nb)
        out = with_inputs(out, img, K, c2w)
        pics = [render(out, tgt, Kt, side, side)[0, 0].clamp(0, 1) for side in (SIDE, 2 * SIDE)]
        want = [x[target].float() / 255 for x in (scene.small, scene.large)]
        psnr = [-10 * math.log10(max(((p - w) ** 2).mean().item(), 1e-9)) for p, w in zip(pics, want)]
        figures = psnr[0], ssim(pics[0][None], want[0][None])[0].item(), psnr[1]
        return (figures, pics, want) if pictures else figures
