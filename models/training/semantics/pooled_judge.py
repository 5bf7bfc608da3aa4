"""Judges an image tower on things that training never saw: named from the cut, from the whole photo, from both.

    python pooled_judge.py --pack PACK [--weights FILE ...] [--shares 0.35 0.5 1] [--onnx FILE ...] [--sides 576] [--by-size]

*Right*: of the photo's own names and 214 everyday words the best is the thing's name or may be said of it; *five*: its name
is among the best five of them; *found*: its name beats the canon; *absent*: share of the words found that may
not be said; *at 3 %*: found where the canon is moved until 3 % of those are found (one shift for all things).
Sets: `open` (names of withheld.txt; the tower that training begins with saw some of them), `fresh` (those of them in sets that it did not see), `held` (held-out photographs, other names), `scenes` (the posed scenes that choose).
*Cut*: the square on black. *Context*: the dense output of the whole photo, its longer side as --sides says, weighted by how much of
each cell lies under the mask. *Both*: the sum of the two unit vectors.
"""
import argparse
import json
import os

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

import cuts
from pictures import POOL, decoded
from towers import STRIDE, PooledTower, normalised
from words_model import SIDE

# Sets that no training before this one saw.
FRESH = ("rooms_polygons", "pantry_polygons", "tools_polygons", "ikea_cutouts", "objects_photos")
KIND = "cuda" if torch.cuda.is_available() else "cpu"


class Judge:
    """The judged things, ready on `device`."""

    def __init__(self, pack, device, sides=(576,), limit=0):
        self.device, self.sides = device, sides
        z = json.load(open(os.path.join(pack, "judge.json")))
        self.things = z["things"][:: max(1, len(z["things"]) // limit)] if limit else z["things"]
        text = np.load(os.path.join(pack, "judge_texts.npy"))
        self.text = F.normalize(torch.from_numpy(text), dim=-1).to(device)
        self.canon = F.normalize(torch.from_numpy(np.load(os.path.join(pack, "words.npz"))["canon"]).float(), dim=-1).to(device)
        n, w = len(self.things), len(text)
        state = np.full((n, w), 2, np.uint8)  # 2: not asked; 1: may be said; 0: absent
        for k, t in enumerate(self.things):
            state[k, t["asked"]] = t["good"]
        self.state = torch.from_numpy(state).to(device)
        self.label = torch.tensor([t["label_at"] for t in self.things], device=device)
        is_kind = {k: lambda t, k=k: t["kind"] == k for k in ("open", "held", "scenes")} | {"fresh": lambda t: t["kind"] == "open" and t["set"] in FRESH}
        self.kinds = {k: torch.tensor([i for i, t in enumerate(self.things) if of(t)], device=device, dtype=torch.long) for k, of in is_kind.items()}
        files = {}
        for s in sorted({t["set"] for t in self.things}):
            with np.load(os.path.join(pack, f"photos_{s}.npz")) as z:
                files[s] = {k: z[k] for k in ("blob", "offsets", "mask", "mask_at")}
        self.photos = sorted({(t["set"], t["photo"]) for t in self.things})
        order = {p: i for i, p in enumerate(self.photos)}
        self.photo = torch.tensor([order[t["set"], t["photo"]] for t in self.things])
        load = lambda p: (decoded(files[p[0]]["blob"], files[p[0]]["offsets"], p[1]), decoded(files[p[0]]["mask"], files[p[0]]["mask_at"], p[1], "L"))
        self.pictures = list(POOL.map(load, self.photos))

        def square(k):
            photo, label = self.pictures[self.photo[k]]
            mask = label == self.things[k]["index"]
            return np.asarray(Image.fromarray(cuts.square(photo, mask)).resize((SIDE, SIDE), Image.BILINEAR)), mask.mean()

        got = list(POOL.map(square, range(n)))
        self.cuts = torch.from_numpy(np.stack([g[0] for g in got]))
        self.area = torch.tensor([float(g[1]) for g in got], device=device)
        self.whole = {}
        for side in sides:  # photos of one size together
            by = {}
            for small, rows, weights in POOL.map(lambda i: self.scaled(i, side), range(len(self.photos))):
                by.setdefault(tuple(small.shape), []).append((small, rows, weights))
            self.whole[side] = [v[a : a + 12] for v in by.values() for a in range(0, len(v), 12)]

    def scaled(self, i, side):
        """A photo with its longer side `side`, both sides in whole cells, and what cells lie under its masks."""
        photo, label = self.pictures[i]
        h, w = photo.shape[:2]
        k = side / max(h, w)
        size = [max(STRIDE, round(v * k / STRIDE) * STRIDE) for v in (h, w)]
        small = np.asarray(Image.fromarray(photo).resize((size[1], size[0]), Image.BILINEAR))
        rows = [j for j in torch.nonzero(self.photo == i)[:, 0].tolist()]
        masks = torch.from_numpy(np.stack([label == self.things[j]["index"] for j in rows])).float()
        weights = F.adaptive_avg_pool2d(masks[:, None], (size[0] // STRIDE, size[1] // STRIDE))[:, 0]
        return torch.from_numpy(small.copy()), rows, weights

    @torch.no_grad()
    def embeddings(self, tower):
        """{"cut": [N,384], side: [N,384], ...} of unit length."""
        put = lambda x: normalised(x.to(self.device).permute(0, 3, 1, 2).float() / 255)
        out = {"cut": torch.cat([tower.cut(put(x)) for x in self.cuts.split(64)])}
        for side, photos in self.whole.items():
            rows = torch.empty(len(self.things), self.text.shape[1], device=self.device)
            for some in photos:
                of = torch.tensor([i for i, s in enumerate(some) for _ in s[1]], device=self.device)
                which = [r for s in some for r in s[1]]
                rows[which] = tower.pooled(put(torch.stack([s[0] for s in some])), of, torch.cat([s[2] for s in some]).to(self.device))
            out[side] = rows
        return out

    @torch.no_grad()
    def figures(self, f, only=None):
        """Figures of unit vectors [N,384], of each set."""
        score, floor = f @ self.text.T, (f @ self.canon.T).amax(1)
        mine = score.gather(1, self.label[:, None])[:, 0]
        asked = score.masked_fill(self.state == 2, -9)
        out = {}
        for kind, rows in self.kinds.items():
            if only is not None:
                rows = rows[only[rows]]
            if not len(rows):
                continue
            s, st, m, fl = asked[rows], self.state[rows], mine[rows], floor[rows]
            right = (st.gather(1, s.argmax(1)[:, None])[:, 0] == 1).float()
            five = ((s > m[:, None]).sum(1) < 5).float()
            gap = (s - fl[:, None])[st == 0]
            shift = gap.kthvalue(max(1, int(len(gap) * 0.97))).values
            v = [right, five, (m >= fl).float(), None, (m >= fl + shift).float()]
            row = [float((gap >= 0).float().mean()) if x is None else float(x.mean()) for x in v]
            out[kind] = [round(100 * x, 1) for x in row] + [round(float(shift), 3), len(rows)]
        return out

    def all(self, tower, detail=False):
        e = self.embeddings(tower)
        unit = lambda x: F.normalize(x, dim=-1)
        out = {"cut": self.figures(e["cut"])}
        for side in self.sides:
            out[f"context {side}"] = self.figures(e[side])
            out[f"both {side}"] = self.figures(unit(e["cut"] + e[side]))
        return (out, e) if detail else out


NAMES = "right five found absent at3% shift n"


def table(title, figures):
    print(title, f"({NAMES})", flush=True)
    for way, sets in figures.items():
        print(f"  {way:13s}", "  ".join(f"{k} {v}" for k, v in sets.items()), flush=True)


def tower_of(pack, device, weights=None, share=1.0):
    """The tower that training begins with, or the way `share` from it to the weights of a checkpoint."""
    with np.load(os.path.join(pack, "start.npz")) as z:
        start = {k: torch.from_numpy(z[k].astype(np.float32)) for k in z.files}
    tower = PooledTower().load_folded(start).to(device).eval()
    if weights:
        theirs, mine = torch.load(weights, map_location=device), tower.state_dict()
        tower.load_state_dict({k: v + share * (theirs[k].to(v.dtype) - v) for k, v in mine.items()})
    # In the plain layout: in the other one cuDNN compiles each depthwise convolution anew for each size.
    return tower.requires_grad_(False)


class OnnxTower:
    """An exported tower (pooled_export.py), on the CPU, as the product runs it."""

    def __init__(self, path, threads=2):
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        self.run = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def cut(self, x):
        return torch.from_numpy(self.run.run(["embeddings"], {"images": x.contiguous().numpy()})[0])

    def pooled(self, x, photo, weights):
        dense = torch.from_numpy(self.run.run(["dense"], {"images": x.contiguous().numpy()})[0])[photo]
        return F.normalize((dense * weights[:, None]).sum((2, 3)) / weights.sum((1, 2)).clamp(min=1e-6)[:, None], dim=-1)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--weights", nargs="*", default=[])
    ap.add_argument("--shares", type=float, nargs="*", default=[0.35, 0.5, 0.65, 1.0])
    ap.add_argument("--sides", type=int, nargs="*", default=[576])
    ap.add_argument("--limit", type=int, default=0, help="about so many things, to try the program")
    ap.add_argument("--by-size", action="store_true", help="mixtures of cut and context, by the thing's share of the photo")
    ap.add_argument("--onnx", nargs="*", default=[], help="exported towers (on the CPU)")
    ap.add_argument("--no-start", action="store_true", help="leave the tower out that training begins with")
    args = ap.parse_args()
    device = torch.device(KIND)
    judge = Judge(args.pack, device, args.sides, args.limit)
    print({k: len(v) for k, v in judge.kinds.items()}, "photos", len(judge.photos), flush=True)
    towers = [("start", lambda: tower_of(args.pack, device))][args.no_start :]
    towers += [(f"{os.path.basename(w)} share {s}", lambda w=w, s=s: tower_of(args.pack, device, w, s)) for w in args.weights for s in args.shares]
    towers += [(os.path.basename(p), lambda p=p: OnnxTower(p)) for p in args.onnx]
    for title, make in towers:
        figures, e = judge.all(make(), True)
        table(title, figures)
        if args.by_size:
            edges = [0, 0.01, 0.03, 0.1, 2]
            for a, b in zip(edges, edges[1:]):
                only = (judge.area >= a) & (judge.area < b)
                rows = {"cut": judge.figures(e["cut"], only)}
                for side in args.sides:
                    rows |= {f"{side} x {k}": judge.figures(F.normalize(e["cut"] + k * e[side], dim=-1), only) for k in (0.5, 1, 2)}
                    rows[f"{side} alone"] = judge.figures(e[side], only)
                table(f"{title}, share of the photo {a} to {b}", rows)


if __name__ == "__main__":
    main()
