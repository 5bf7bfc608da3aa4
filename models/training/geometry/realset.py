"""Packs the evaluation triples of the shared real scenes for `train.py --real`: looked at, never
trained on. The figure that counts is `segsplat-lab photos`, through the shipped ONNX and the product's
renderer; this is the same protocol in PyTorch, with depth ranges from a plain plane sweep.

    python realset.py --scenes ../../../../shared/data/scenes --out /tmp/realset.pt
"""
import argparse
import io
import json
import os

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

SIDE = 256


def load_scene(folder):
    """Undistorted, centre-cropped, resized photos; K normalised; OpenCV camera-to-world."""
    t = json.load(open(os.path.join(folder, "transforms.json")))
    images, Ks, poses = [], [], []
    for f in t["frames"]:
        get = lambda k: f.get(k, t.get(k, 0)) or 0
        img = Image.open(os.path.join(folder, f["file_path"])).convert("RGB")
        w, h = img.size
        fx, fy, cx, cy = get("fl_x"), get("fl_y"), get("cx"), get("cy")
        dist = [get(k) for k in ("k1", "k2", "p1", "p2")]
        x = torch.from_numpy(np.asarray(img).copy()).permute(2, 0, 1)[None].float()
        if any(dist):
            k1, k2, p1, p2 = dist
            v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
            a, b = (u - cx) / fx, (v - cy) / fy
            r = a * a + b * b
            d = 1 + k1 * r + k2 * r * r
            xd = a * d + 2 * p1 * a * b + p2 * (r + 2 * a * a)
            yd = b * d + p1 * (r + 2 * b * b) + 2 * p2 * a * b
            grid = torch.stack([(xd * fx + cx) / w * 2 - 1, (yd * fy + cy) / h * 2 - 1], -1)[None].float()
            x = F.grid_sample(x, grid, mode="bilinear", padding_mode="border", align_corners=False)
        s = min(w, h)
        x0, y0 = (w - s) // 2, (h - s) // 2
        x = x[:, :, y0 : y0 + s, x0 : x0 + s]
        pil = Image.fromarray(x[0].permute(1, 2, 0).round().clamp(0, 255).byte().numpy())
        images.append(torch.from_numpy(np.asarray(pil.resize((SIDE, SIDE), Image.BOX if s % SIDE == 0 else Image.BICUBIC)).copy()))
        Ks.append([[fx / s, 0, (cx - x0) / s], [0, fy / s, (cy - y0) / s], [0, 0, 1]])
        m = np.array(f["transform_matrix"], float)
        m[:3, 1:3] *= -1
        poses.append(m)
    return torch.stack(images), torch.tensor(Ks, dtype=torch.float64), torch.tensor(np.stack(poses))


def sweep(img_a, Ka, Pa, img_b, Kb, Pb, n=192, side=128):
    """Confident inverse depths of a from b by ZNCC over 7x7 windows: values in world units."""
    ga, gb = [F.interpolate(i.permute(2, 0, 1)[None].float().mean(1, keepdim=True), (side, side), mode="area") / 255 for i in (img_a, img_b)]
    base = (Pa[:3, 3] - Pb[:3, 3]).norm()
    R = Pb[:3, :3].T @ Pa[:3, :3]
    t = Pb[:3, :3].T @ (Pa[:3, 3] - Pb[:3, 3])
    c = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    gy, gx = torch.meshgrid(c, c, indexing="ij")
    rays = torch.stack([(gx - Ka[0, 2]) / Ka[0, 0], (gy - Ka[1, 2]) / Ka[1, 1], torch.ones_like(gx)], -1) @ R.T
    invs = torch.linspace(0, 1 / (0.6 * float(base)), n, dtype=torch.float64)
    blur = lambda x: F.avg_pool2d(x, 7, 1, 3)
    ma = blur(ga)
    va = blur(ga * ga) - ma * ma
    scores = []
    for q in invs:
        p = rays + t * q
        w = p[..., 2:].clamp(min=1e-6)
        xy = torch.stack([p[..., 0] / w[..., 0] * Kb[0, 0] + Kb[0, 2], p[..., 1] / w[..., 0] * Kb[1, 1] + Kb[1, 2]], -1) * 2 - 1
        ok = ((xy.abs().amax(-1) < 1) & (p[..., 2] > 1e-6)).float()
        b = F.grid_sample(gb, xy[None].float().clamp(-4, 4), align_corners=False)
        mb = blur(b)
        vb = blur(b * b) - mb * mb
        z = (blur(ga * b) - ma * mb) / (va * vb).clamp(min=1e-8).sqrt()
        scores.append(torch.where(blur(ok[None, None]) > 0.95, z, torch.full_like(z, -1))[0, 0])
    s = torch.stack(scores)
    best, at = s.max(0)
    far_mask = (torch.arange(n)[:, None, None] - at[None]).abs() > 4
    second = torch.where(far_mask, s, torch.full_like(s, -1)).amax(0)
    good = (best > 0.85) & (best - second > 0.06) & (va[0, 0] > 2e-4) & (at > 0) & (at < n - 2)
    return invs[at[good]]


def warp_psnr(target, Kt, Pt, sources):
    """Best constant-depth warp: 24 depths, either input, bilinear, border repeated."""
    base = (sources[0][2][:3, 3] - sources[1][2][:3, 3]).norm()
    c = (torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE
    gy, gx = torch.meshgrid(c, c, indexing="ij")
    rays = torch.stack([(gx - Kt[0, 2]) / Kt[0, 0], (gy - Kt[1, 2]) / Kt[1, 1], torch.ones_like(gx)], -1)
    want = target.permute(2, 0, 1)[None].float() / 255
    best = -1e9
    for img, K, P in sources:
        x = img.permute(2, 0, 1)[None].float() / 255
        R = P[:3, :3].T @ Pt[:3, :3]
        t = P[:3, :3].T @ (Pt[:3, 3] - P[:3, 3])
        for z in torch.logspace(0, np.log10(30), 24, dtype=torch.float64) * base:
            p = rays * z @ R.T + t
            w = p[..., 2:].clamp(min=1e-6)
            xy = torch.stack([p[..., 0] / w[..., 0] * K[0, 0] + K[0, 2], p[..., 1] / w[..., 0] * K[1, 1] + K[1, 2]], -1) * 2 - 1
            y = F.grid_sample(x, xy[None].float(), padding_mode="border", align_corners=False)
            best = max(best, float(-10 * torch.log10(((y - want) ** 2).mean())))
    return best


def triples(P, scale):
    c, ax = P[:, :3, 3], P[:, :3, 2]
    ang = torch.rad2deg(torch.arccos((ax @ ax.T).clamp(-1, 1)))
    for i in range(len(P)):
        for j in range(i + 1, len(P)):
            b = (c[i] - c[j]).norm()
            if not (0.25 * scale <= b <= 1.3 * scale) or ang[i, j] >= 22:
                continue
            mid = (c[i] + c[j]) / 2
            d = (c - mid).norm(dim=1)
            d[[i, j]] = 1e9
            k = int(d.argmin())
            if d[k] < 0.45 * b and ang[i, k] < 20:
                yield i, j, k


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--scenes", required=True)
    ap.add_argument("--out", required=True)
    args = ap.parse_args()
    torch.set_num_threads(2)
    scenes, items = {}, []
    for name in sorted(os.listdir(args.scenes)):
        img, K, P = load_scene(os.path.join(args.scenes, name))
        d = torch.cdist(P[:, :3, 3], P[:, :3, 3]) + torch.eye(len(P)) * 1e9
        scale = 1.0 if name == "fox" else float(np.median(d.min(1).values.numpy())) / 0.30
        scenes[name] = {"images": img, "K": K, "c2w": P}
        cache = {}
        rows = list(triples(P, scale))
        for n, (i, j, k) in enumerate(rows):
            warp = warp_psnr(img[k], K[k], P[k], [(img[i], K[i], P[i]), (img[j], K[j], P[j])])
            order = (P[:, :3, 3] - P[k, :3, 3]).norm(dim=1).argsort().tolist()
            more = [x for x in order if x not in (i, j, k)][:2]
            for views in ([i, j], [i, j] + more):
                near, far = [], []
                for a in views:
                    q = []
                    for b in views:
                        if a != b:
                            if (a, b) not in cache:
                                cache[a, b] = sweep(img[a], K[a], P[a], img[b], K[b], P[b])
                            q.append(cache[a, b])
                    q = torch.cat(q).numpy()
                    near.append(np.nan if len(q) < 30 else np.percentile(q, 98))
                    far.append(np.nan if len(q) < 30 else np.percentile(q, 2))
                base = float((P[i, :3, 3] - P[j, :3, 3]).norm())
                hi, lo = np.array(near), np.array(far)
                hi = np.where(np.isnan(hi), np.nanmax(hi) if not np.isnan(hi).all() else 1 / base, hi)
                lo = np.where(np.isnan(lo), np.nanmin(lo) if not np.isnan(lo).all() else 0.01 / base, lo)
                span = np.maximum(hi - lo, 0.05 * hi)
                hi, lo = hi + 0.15 * span, np.maximum(lo - 0.15 * span, 1e-3 / base)
                items.append({"scene": name, "views": views, "target": k, "near": (1 / hi).tolist(), "far": (1 / lo).tolist(), "warp": warp, "show": n % max(len(rows) // 2, 1) == 0})
        own = [x for x in items if x["scene"] == name and len(x["views"]) == 2]
        print(name, len(own), "warp", round(float(np.mean([x["warp"] for x in own])), 2), "near", np.round(own[0]["near"], 2), "far", np.round(own[0]["far"], 2), flush=True)
    for name, sc in scenes.items():
        used = {v for x in items if x["scene"] == name for v in [*x["views"], x["target"]]}
        sc["images"] = [webp(im) if n in used else None for n, im in enumerate(sc["images"])]
    torch.save({"scenes": scenes, "items": items}, args.out)


def webp(img):
    buf = io.BytesIO()
    Image.fromarray(img.numpy()).save(buf, "WEBP", lossless=True)
    return buf.getvalue()


def read(path):
    """The pack with its pictures decoded: [N, 256, 256, 3] uint8, zeros where unused."""
    data = torch.load(path, weights_only=False)
    for sc in data["scenes"].values():
        pics = [np.zeros((SIDE, SIDE, 3), np.uint8) if b is None else np.asarray(Image.open(io.BytesIO(b))) for b in sc["images"]]
        sc["images"] = torch.from_numpy(np.stack(pics))
    return data


if __name__ == "__main__":
    main()
