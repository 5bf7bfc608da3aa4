"""Training sets of real photos: what captures.py and pairs.py wrote, on the device.

A set is a target photo, inputs on both sides of it, and more inputs around, from narrow baselines
to wide ones. Nothing but photos and cameras is used: the loss is the picture of the target.
"""
import json
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from sweep import Ranges, gray

PX_MOST = 0.9  # photos whose poses are worse are left out
# Baseline over the median depth of the target, and how often each step is drawn.
ANGLES = [0.015, 0.04, 0.08, 0.16, 0.3, 0.5, 1.0]
SHARES = [0.08, 0.2, 0.27, 0.25, 0.15, 0.05]
GAIN_MOST = 0.4


class Capture:
    """The photos of one place, and which of them go together."""

    def __init__(self, folder, device):
        with open(os.path.join(folder, "cameras.json")) as file:
            about = json.load(file)
        self.name, self.held_out = about["name"], about.get("held_out", False)
        pairs = np.load(os.path.join(folder, "pairs.npz"))
        frames, px = about["frames"], pairs["px"]
        worst = np.array([np.median(px[(px[:, 0] == i) | (px[:, 1] == i), 2]) if ((px[:, :2] == i).any()) else 9 for i in range(len(frames))])
        keep = [i for i in range(len(frames)) if worst[i] < PX_MOST and np.isfinite(pairs["inverse"][i]).all()]
        read = lambda i: np.array(Image.open(os.path.join(folder, frames[i]["file"])).convert("RGB"))
        with ThreadPoolExecutor(8) as pool:
            self.images = [torch.from_numpy(img).permute(2, 0, 1).to(device) for img in pool.map(read, keep)]
        self.K = np.array([frames[i]["K"] for i in keep])
        self.c2w = np.array([frames[i]["c2w"] for i in keep])
        self.inverse = pairs["inverse"][keep]
        self.overlap = pairs["overlap"][np.ix_(keep, keep)]
        self.gain = pairs["gain"][keep][:, ::-1].clip(-GAIN_MOST, GAIN_MOST)  # BGR there
        c = self.c2w[:, :3, 3]
        self.distance = np.linalg.norm(c[:, None] - c[None], axis=2)
        known = os.path.join(folder, "known.npz")
        if os.path.exists(known):  # of an earlier run
            known = np.load(known)
            self.ranges, self.triples = known["ranges"], [known[f"triples_{n}"] for n in range(len(SHARES))]
            return
        self.ranges, self.triples = self.measured(device), self.by_angle()
        np.savez(known[:-4] + f"-{os.getpid()}.npz", ranges=self.ranges, **{f"triples_{n}": t for n, t in enumerate(self.triples)})
        os.replace(known[:-4] + f"-{os.getpid()}.npz", known)

    def measured(self, device):
        """[N,2] farthest and nearest inverse depth: of the sparse points and of a sweep."""
        size = np.array([[x.shape[2], x.shape[1], 1] for x in self.images])
        sweeps = Ranges([gray(x.float() / 255) for x in self.images], torch.from_numpy(self.K / size[:, :, None]), torch.from_numpy(self.c2w))
        out = self.inverse[:, [0, 2]].copy()
        for i in range(len(out)):
            angle = self.distance[i] * self.inverse[i, 1]
            both = np.minimum(self.overlap[i], self.overlap[:, i])
            worth = both * np.exp(-0.5 * np.log(np.maximum(angle, 1e-6) / 0.12) ** 2) * (angle > 0.01)
            partners = [int(j) for j in np.argsort(-worth)[:4] if worth[j] > 0.02]
            found = sweeps.bounds(i, partners) if partners else None
            if found:
                out[i] = min(out[i, 0], max(found[0], 1e-3 * out[i, 1])), max(out[i, 1], min(found[1], 3 * out[i, 1]))
        return out

    def by_angle(self):
        """For each step of ANGLES the (target, input, input) with the target about between them."""
        steps = [[] for _ in SHARES]
        c = self.c2w[:, :3, 3]
        for t in range(len(c)):
            near = np.where((self.overlap[t] > 0.3) & (self.overlap[:, t] > 0.2) & (self.distance[t] > 0))[0]
            near = near[np.argsort(self.distance[t, near])][:28]
            for a, i in enumerate(near):
                for j in near[a + 1 :]:
                    b = self.distance[i, j]
                    away = np.linalg.norm(c[t] - (c[i] + c[j]) / 2)
                    if away > 0.5 * b or min(self.overlap[i, j], self.overlap[j, i]) < 0.2 or max(self.overlap[t, i], self.overlap[t, j]) < 0.6:
                        continue
                    step = np.searchsorted(ANGLES, b * self.inverse[t, 1]) - 1
                    if 0 <= step < len(SHARES):
                        steps[step].append((t, int(i), int(j)))
        return [np.array(s) for s in steps]

    def draw(self, rng, V, T):
        """Indices of V inputs and T targets."""
        share = np.array([p if len(s) else 0 for p, s in zip(SHARES, self.triples)])
        rows = self.triples[rng.choice(len(share), p=share / share.sum())]
        t, i, j = (int(x) for x in rows[rng.integers(len(rows))])
        views, taken = [i, j], {t, i, j}
        # More inputs: nearest to the target as a walk gives them, or spread over what overlaps.
        ties = np.maximum(self.overlap[:, views].max(1), self.overlap[:, t])
        others = [k for k in np.argsort(self.distance[t]) if k not in taken and ties[k] > 0.25]
        if rng.random() < 0.5:
            others = list(rng.permutation(others[: 3 * V]))
        views += [int(k) for k in others[: V - 2]]
        if len(views) < V:
            return None
        targets = [t]
        spare = [int(k) for k in others if k not in views and self.overlap[k, views].max() > 0.6][:6]
        while len(targets) < T:
            targets.append(spare[rng.integers(len(spare))] if spare else t)
        rng.shuffle(views)
        return views, targets


class Captures:
    """Batches over all captures of a folder that are not held out."""

    def __init__(self, root, device, seed, only=None):
        self.device, self.rng = device, np.random.default_rng(seed)
        self.all = []
        for name in only or sorted(os.listdir(root)):
            with open(os.path.join(root, name, "cameras.json")) as file:
                if json.load(file).get("held_out"):
                    continue
            capture = Capture(os.path.join(root, name), device)
            if sum(len(s) for s in capture.triples):
                self.all.append(capture)
        size = np.array([math.sqrt(len(c.images)) for c in self.all])
        self.share = size / size.sum()

    def about(self):
        return {c.name: [len(c.images)] + [len(s) for s in c.triples] for c in self.all}

    def batch(self, B, V, T, size, target_size):
        """B sets in the model frame: images [B,V,3,*size], targets [B,T,3,*target_size], mask
        [B,T,1,..] of what an input may see, K [B,V+T,3,3] normalised, c2w [B,V+T,4,4], near/far [B,V].
        """
        sets = []
        while len(sets) < B:
            capture = self.all[self.rng.choice(len(self.all), p=self.share)]
            got = capture.draw(self.rng, V, T)
            if got:
                sets.append(self.one(capture, *got, size, target_size))
        images, targets, K, c2w, near, far, own = zip(*sets)
        put = lambda x: torch.from_numpy(np.stack(x)).float().to(self.device)
        K, c2w = put(K), put(c2w)
        mask = seen(K, c2w, put(own), V, *(length // 8 for length in target_size))
        mask = F.interpolate(mask.flatten(0, 1), target_size, mode="nearest").reshape(B, T, 1, *target_size)
        return torch.stack(images), torch.stack(targets), mask, K, c2w, put(near), put(far)

    def one(self, capture, views, targets, size, target_size):
        r = self.rng
        flip, part = r.random() < 0.5, 1.0 if r.random() < 0.5 else r.uniform(0.7, 1.0)
        at = r.uniform(0.2, 0.8, 2) if part < 1 else np.array([0.5, 0.5])
        light = np.exp(r.normal(0, 0.08) + r.normal(0, 0.02, 3)) if r.random() < 0.5 else np.ones(3)
        pics, Ks = [], []
        mean = capture.gain[views].mean(0)
        for n, k in enumerate([*views, *targets]):
            img, K = crop(capture.images[k], capture.K[k], target_size if n >= len(views) else size, part, at, flip)
            gain = light * np.exp(mean - capture.gain[k]) if n >= len(views) else light
            pics.append((img * torch.tensor(gain, device=img.device, dtype=torch.float32)[:, None, None]).clamp(0, 1))
            Ks.append(K)
        c2w = np.linalg.inv(capture.c2w[views[0]]) @ capture.c2w[[*views, *targets]]
        if flip:
            mirror = np.diag([-1.0, 1, 1, 1])
            c2w = mirror @ c2w @ mirror
        V = len(views)
        scale = np.linalg.norm(c2w[:V, None, :3, 3] - c2w[None, :V, :3, 3], axis=2).max()
        c2w[:, :3, 3] /= scale
        lo, hi = (capture.ranges[views] * scale).T
        near, far = self.near_far(lo, hi)
        return torch.stack(pics[:V]), torch.stack(pics[V:]), np.stack(Ks), c2w, near, far, capture.ranges[targets] * scale

    def near_far(self, lo, hi):
        """A margin as at run time; at times a loose range, as a false match gives."""
        r, n = self.rng, len(lo)
        span = np.maximum(hi - lo, 0.05 * hi)
        grow = lambda: np.where(r.random(n) < 0.75, r.uniform(0.05, 0.35, n), np.where(r.random(n) < 0.75, r.uniform(0.2, 0.9, n), r.uniform(0.5, 3.0, n)))
        lo, hi = np.maximum(lo - span * grow(), 1e-3), hi + span * grow()
        if r.random() < 0.15:
            lo, hi = np.full(n, lo.min()), np.full(n, hi.max())
        return 1 / hi, 1 / lo


def crop(img, K, size, part, at, flip):
    """A part of a photo in the shape of a size (height, width), at that size; K normalised."""
    h, w = img.shape[1:]
    H, W = size
    aspect = W / H
    cw, ch = (h * aspect, h) if w / h > aspect else (w, w / aspect)
    cw, ch = cw * part, ch * part
    x0, y0 = (w - cw) * at[0], (h - ch) * at[1]
    # Twice the samples, averaged: no aliasing at reductions up to about 2.5.
    more = 2 if cw > 1.2 * W else 1
    oh, ow = H * more, W * more
    theta = torch.tensor([[cw / w, 0, (2 * x0 + cw) / w - 1], [0, ch / h, (2 * y0 + ch) / h - 1]], device=img.device, dtype=torch.float32)
    if flip:
        theta[0, 0] *= -1
    grid = F.affine_grid(theta[None], (1, 3, oh, ow), align_corners=False)
    out = F.grid_sample(img[None].float() / 255, grid, padding_mode="border", align_corners=False)
    if more > 1:
        out = F.avg_pool2d(out, more)
    cx = (K[0, 2] - x0) / cw
    return out[0], np.array([[K[0, 0] / cw, 0, 1 - cx if flip else cx], [0, K[1, 1] / ch, (K[1, 2] - y0) / ch], [0, 0, 1]])


def seen(K, c2w, own, V, h, w, planes=8):
    """[B,T,1,h,w]: 1 where at half of the depths of a target's range some input sees the place."""
    B, T = K.shape[0], K.shape[1] - V
    y, x = (torch.arange(h, device=K.device) + 0.5) / h, (torch.arange(w, device=K.device) + 0.5) / w
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    pix = torch.stack([gx, gy, torch.ones_like(gx)], -1).reshape(-1, 3)
    rays = pix @ torch.linalg.inv(K[:, V:]).transpose(-1, -2)  # [B,T,P,3]
    steps = torch.linspace(0, 1, planes, device=K.device)
    inv = own[..., :1] + (own[..., 1:] - own[..., :1]) * steps  # [B,T,D]
    p = rays[:, :, None] / inv[..., None, None].clamp(min=1e-6)  # [B,T,D,P,3]
    rel = torch.linalg.inv(c2w[:, None, :V]) @ c2w[:, V:, None]  # [B,T,V,4,4]
    q = torch.einsum("btvij,btdpj->btvdpi", rel[..., :3, :3], p) + rel[..., None, None, :3, 3]
    uv = torch.einsum("bvij,btvdpj->btvdpi", K[:, :V], q)
    xy = uv[..., :2] / uv[..., 2:].clamp(min=1e-6)
    inside = (uv[..., 2] > 1e-6) & (xy > 0).all(-1) & (xy < 1).all(-1)
    return (inside.any(2).float().mean(2) >= 0.5).float().reshape(B, T, 1, h, w)
