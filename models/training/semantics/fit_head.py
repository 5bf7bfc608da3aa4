"""Fits the last matrix of the image tower to real cuts; the network before it stays, so what it knows stays.

    python fit_head.py --pack PACK --image ../../embedded/image_tower.onnx --features FOLDER --share 0.5 --lower 0.06 \
        --out image_tower.onnx [--withhold]

Minutes on one core: the pooled 1,280 features of a part of the cuts and photographs are computed once (--features).
Losses, teacher and withheld names are those of train_open.py; --withhold prints what that loses and gains on names
that were kept out. The matrix goes `share` of the way; `--lower` takes that share of what points at the canon out.
"""
import argparse
import io
import json
import math
import os
from collections import Counter

import numpy as np
import onnx
import onnxruntime as ort
import torch
import torch.nn.functional as F
from PIL import Image

import cuts
from export import fold, write
from train_open import ABSENT, withheld_words
from train_real import decode, folded, letterbox
from words_model import SIDE, ImageTower

# At most so many of a class: drawn things; photographs of each set.
DRAWN_MOST, PHOTOS_MOST = 70, {0: 6, 1: 8, 2: 1, 3: 3}


def features(image, squares):
    """What goes into the last matrix, [N,1280], of pictures u8 [n,n,3]."""
    model = onnx.load(image)
    name = [n for n in model.graph.node if n.op_type in ("Gemm", "MatMul")][-1].input[0]
    model.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    run, out = ort.InferenceSession(model.SerializeToString()), []
    for at in range(0, len(squares), 16):
        x = np.stack([np.asarray(Image.fromarray(q).resize((SIDE, SIDE), Image.BILINEAR), np.float32) for q in squares[at : at + 16]])
        out.append(run.run([name], {"images": ((x - 127) / 128).transpose(0, 3, 1, 2).copy()})[0].reshape(-1, 1280))
    return np.concatenate(out).astype(np.float16)


def pictures(pack):
    """(name, squares, classes) of drawn things under their outlines, held-out ones, and whole photographs."""
    at, rng, count, keep = lambda n: os.path.join(pack, n), np.random.default_rng(0), Counter(), []
    z = np.load(at("photos.npz"))
    for i in rng.permutation(len(z["label"])):
        c = (int(z["source"][i]), int(z["label"][i]))
        if count[c] < PHOTOS_MOST[c[0]]:
            count[c] += 1
            keep.append(i)
    raw, off = z["blob"].tobytes(), z["offsets"]
    photo = lambda i: letterbox(np.asarray(Image.open(io.BytesIO(raw[off[i] : off[i + 1]])).convert("RGB")), SIDE)
    yield "photos", [photo(i) for i in keep], z["label"][keep]
    for name, file, most in (("drawn", "drawn.npz", DRAWN_MOST), ("held", "drawn_held.npz", 10**9)):
        z, count, rows = np.load(at(file)), Counter(), []
        photos, masks, thing = decode(z), decode(z, "mask", "mask_at", "L"), z["thing"]
        for k in rng.permutation(len(thing)):
            p, n, c, _ = thing[k]
            if c >= 0 and count[c] < most and (masks[p] == n).sum() >= 60:
                count[c] += 1
                rows.append(k)
        yield name, [cuts.square(photos[thing[k, 0]], masks[thing[k, 0]] == thing[k, 1]) for k in rows], thing[rows, 2]


class Fit:
    def __init__(self, args):
        torch.manual_seed(0)
        z = np.load(os.path.join(args.pack, "words.npz"))
        get = lambda n: torch.from_numpy(z[n])
        self.tw, self.canon = (F.normalize(get(n).float(), dim=-1) for n in ("embed", "canon"))
        self.truth, self.own, self.everyday = get("truth"), get("own").long(), get("everyday").long()
        self.own_words, self.own_of = torch.unique(self.own, return_inverse=True)
        index = {str(w): i for i, w in enumerate(z["words"])}
        listed = torch.tensor([index[w] for w in withheld_words()])
        self.open = (self.truth[: len(self.own)][:, listed] == 1).any(1) | torch.isin(self.own, listed)
        self.state = folded(args.image)
        self.first = [self.state["out.weight"].float(), self.state["out.bias"].float()]
        self.sets = {}
        os.makedirs(args.features, exist_ok=True)
        path = lambda n: os.path.join(args.features, n + ".npz")
        if not all(os.path.exists(path(n)) for n in ("photos", "drawn", "held")):
            for name, squares, cls in pictures(args.pack):
                np.savez(path(name), x=features(args.image, squares), cls=cls)
                print(name, len(squares), flush=True)
        for name in ("photos", "drawn", "held"):
            v = np.load(path(name))
            self.sets[name] = torch.from_numpy(v["x"]).float(), torch.from_numpy(v["cls"]).long()

    def embed(self, head, x):
        return F.normalize(x @ head[0].T + head[1], dim=-1)

    def measure(self, head, x, c):
        f = self.embed(head, x)
        floor, mine = (f @ self.canon.T).amax(1), (f * self.tw[self.own[c]]).sum(1)
        t, s = self.truth[c][:, self.everyday], f @ self.tw[self.everyday].T
        false = (s - floor[:, None])[t == 0]
        shift = false.kthvalue(int(len(false) * (1 - ABSENT))).values
        right = (t.gather(1, s.argmax(1)[:, None])[:, 0] != 0) | (mine >= s.amax(1))
        r = lambda v: round(float(v.float().mean()), 3)
        return {"found": r(mine >= floor), "absent": r(false >= 0), "found at 1.5 %": r(mine >= floor + shift), "shift": r(shift), "right": r(right)}

    def fit(self, withhold, lr=3e-4, hold=10.0, unseen=0.1, steps=300, photos=0.3):
        torch.manual_seed(1)
        (a, ca), (b, cb) = self.sets["drawn"], self.sets["photos"]
        x, c = torch.cat([a, b]), torch.cat([ca, cb])
        is_drawn, target = torch.arange(len(c)) < len(ca), self.embed(self.first, x)
        count = torch.bincount(ca, minlength=len(self.own)).float()
        w = torch.where(is_drawn, count[c].clamp(min=1) ** -0.5, torch.zeros(1))
        q = (~is_drawn).float()
        w = (1 - photos) * w / w.sum() + photos * q / q.sum()
        if withhold:
            w = torch.where(self.open[c], torch.zeros(1), w)
        w = w / w.sum()
        mass = torch.zeros(len(self.own)).index_add_(0, c, w)
        prior = torch.zeros(len(self.own_words)).index_add_(0, self.own_of, mass)
        seen, log_prior = prior > 1e-7, prior.clamp(min=1e-7).log()
        seen_word = ((self.truth[: len(self.own)] == 1) & (mass[:, None] > 3e-4)).any(0)
        head = [v.clone().requires_grad_() for v in self.first]
        opt, mean = torch.optim.Adam(head, lr=lr), [v.clone() for v in self.first]
        for step in range(steps):
            opt.param_groups[0]["lr"] = lr * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * step / steps)))
            k = torch.multinomial(w, 256, True)
            f = self.embed(head, F.dropout(x[k], 0.15))
            cos, t, want = f @ self.tw.T, self.truth[c[k]], self.own_of[c[k]]
            other = (t[:, self.own_words] != 0) & ~F.one_hot(want, len(self.own_words)).bool()
            ce = F.cross_entropy((36 * cos[:, self.own_words] + log_prior).masked_fill(other | ~seen, -1e4), want)
            margin = (cos - (f @ self.canon.T).amax(1, keepdim=True)) * 36
            pos, neg = (t == 1).float(), (t == 0).float() * torch.where(seen_word, 1.0, unseen)
            itself = F.one_hot(self.own_words[want], pos.shape[1]) * pos
            rest = pos - itself
            p_loss = (F.softplus(-margin) * (itself + rest / rest.sum(1, keepdim=True).clamp(min=1))).sum(1) / 2
            near = neg * (margin.detach().sigmoid() + 0.01)
            n_loss = (F.softplus(margin) * near).sum(1) / near.sum(1).clamp(min=1e-3)
            knew = ((target[k] * self.tw[self.own_words[want]]).sum(1) - (target[k] @ self.canon.T).amax(1)) * 20
            held = ((0.05 + 0.5 * knew.sigmoid()) * (1 - (f * target[k]).sum(1))).mean()
            loss = ce + (2 * p_loss + 1.5 * n_loss).mean() + hold * held
            opt.zero_grad()
            loss.backward()
            opt.step()
            with torch.no_grad():
                for m, v in zip(mean, head):
                    m.lerp_(v, 0.02) if step > 50 else m.copy_(v)
        return mean

    def between(self, head, share, lower):
        c = F.normalize(self.canon.mean(0), dim=0)
        w, b = (u + share * (v - u) for u, v in zip(self.first, head))
        return [w - lower * torch.outer(c, c @ w), b - lower * c * (c @ b)]


def main():
    ap = argparse.ArgumentParser()
    for name in ["pack", "image", "features", "out"]:
        ap.add_argument("--" + name, required=name != "out")
    ap.add_argument("--share", type=float, nargs="+", default=[0.5])
    ap.add_argument("--lower", type=float, nargs="+", default=[0.0])
    ap.add_argument("--withhold", action="store_true")
    args = ap.parse_args()
    fit = Fit(args)
    drawn, photos = (fit.sets[k] for k in ("drawn", "photos"))
    sets = {"held-out things": fit.sets["held"], "open things": tuple(v[fit.open[drawn[1]]] for v in drawn),
            "open photographs": tuple(v[fit.open[photos[1]]] for v in photos)}
    tell = lambda tag, head: print(tag, json.dumps({k: fit.measure(head, *v) for k, v in sets.items()}), flush=True)
    tell("shipped", fit.first)
    head = fit.fit(args.withhold)
    for share in args.share:
        for lower in args.lower:
            now = fit.between(head, share, lower)
            tell(f"share {share} lower {lower}", now)
    if args.out:
        tower = fold(ImageTower().eval())
        tower.load_state_dict({**fit.state, "out.weight": now[0], "out.bias": now[1]})
        torch.manual_seed(0)
        write(tower, (torch.rand(2, 3, SIDE, SIDE) * 2 - 1,), args.out, ["images"], ["embeddings"], {"images": {0: "batch"}, "embeddings": {0: "batch"}})


if __name__ == "__main__":
    main()
