"""Trains the image tower on cuts, so that names without outlines are kept, and measures just that.

    python train_open.py --pack PACK --net net.npz --image ../../embedded/image_tower.onnx --out OUT --seconds S \
        --prepared FOLDER [--withhold]
    python train_open.py --prepare ...           # makes the files of --prepared and ends

What never changes (outlines, teachers' answers) is computed once, with --prepare, and read afterwards: GPU time is
for training. With --withhold the names of `withheld.txt` (and all that is a kind of one) are kept out of every
bank of pictures; shares, canon and recipe are chosen on those *open names*, and the twin run without --withhold
ships. Two recipes train on the same batches. What differs from train_real.py:

- Teachers look at each thing once, at its best: the tower that training begins with at the exact cut and at plain
  boxes (their mean names better than either), EfficientNet-Lite2 at the boxes. The tower learns to say the same of
  ragged, merged, hidden and small cuts, named or not (windows of photographs without labels, too).
- Half of the drawn things are cut by the mask network's own masks (net_masks.py): that is what the product cuts.
- A word that no picture of the sets shows is never taught as false with full weight: that is how unknown names sink.
- The frequencies of names are taken out of the choice of a name (logit adjustment).
- Batch norm keeps its statistics, and early layers move less, so that a mean of weights stays a good network.
"""
import argparse
import json
import math
import os
import time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from colours import dominant_colour
from export import fold
from salient import Salient
from train_real import CONTEXT, DIM, DRAWN, KIND, PHOTO, POOL, THING, UNKNOWN, Pictures, decode, exact, folded, letterbox, lite2_of, normalised, outlines, unfold
from words_model import SIDE, ImageTower

HERE = os.path.dirname(os.path.abspath(__file__))
SOURCES = [1.0, 1.6, 7.0, 5.0]  # how often a photograph of each labelled set is seen
TOP = 16  # likeliest names of EfficientNet-Lite2 that are kept
SAVE_EVERY = 60  # seconds: a run that is cut off has weights of the last minute
ABSENT = 0.015  # "found" is also measured at the canon where this share of false words is found
# What the tower that training begins with is shown: brightness outside the outline, margin, weight.
VIEWS = [(0.0, 0.0, 1.0), (1.0, 0.08, 0.6), (1.0, 0.3, 0.4)]
# Learning rate; weight of the teachers' embedding, of EfficientNet-Lite2's opinion, of false words that no set shows.
RECIPES = {"keep": (1.6e-4, 10.0, 0.6, 0.1), "learn": (3e-4, 4.0, 0.4, 0.3)}


def withheld_words():
    return {w for row in open(os.path.join(HERE, "withheld.txt")) if not row.startswith("#") for w in row.strip().split(", ") if w}


class Prepared:
    """Arrays that are computed once and read afterwards: FOLDER/NAME.npz. Without a folder they are always computed."""

    def __init__(self, folder, write):
        self.folder, self.write = folder, write

    def arrays(self, name, compute):
        path = self.folder and os.path.join(self.folder, name + ".npz")
        if path and os.path.exists(path):
            z = np.load(path)
            return [z[k] for k in sorted(z.files)]
        got = compute()
        if path and self.write:
            os.makedirs(self.folder, exist_ok=True)
            np.savez_compressed(path, **{f"a{i}": v for i, v in enumerate(got)})
            print(path, os.path.getsize(path) >> 10, "KiB", flush=True)
        return got


class Bank:
    """Windows u8 [N,R,R,4] with masks, class, how often each is drawn, whether its mask is an outline."""

    def __init__(self, name, pics, cls, weight, outlined):
        self.name, self.pics, self.cls, self.weight, self.outlined = name, pics, cls, weight, outlined

    def only(self, keep):
        out = Bank(self.name, self.pics[keep], self.cls[keep], self.weight[keep], self.outlined[keep])
        out.net, out.net_fits = self.net[keep.to(self.net.device)], self.net_fits[keep.to(self.net.device)]
        return out

    def under_net(self):
        """Windows under the best mask of the mask network, and classes, of the things that it finds."""
        keep = self.net_fits[:, 0]
        return torch.cat([self.pics[keep][..., :3], self.net[keep][:, 0, :, :, None]], -1), self.cls[keep.cpu()]


def few(n, limit):
    return np.arange(n)[:: max(1, n // limit)] if limit else np.arange(n)


def stacked(make, rows):
    return torch.from_numpy(np.stack(list(POOL.map(make, rows))))


def windows(photo, boxes, size, context):
    """What lies around each of `boxes` [K,4] (x0, y0, x1, y1) of a photo [C,h,w] or of one a box [K,C,h,w], 0..255, as
    squares u8 [K,size,size,C]; 0 beyond the photo."""
    h, w = photo.shape[-2:]
    x = photo.float().expand(len(boxes), *photo.shape[-3:])
    x0, y0, x1, y1 = torch.as_tensor(np.array(boxes, np.float32), device=x.device).T
    side = torch.maximum(x1 - x0, y1 - y0) * (1 + 2 * context)
    zero = torch.zeros_like(side)
    theta = torch.stack([torch.stack([side / w, zero, (x0 + x1) / w - 1], -1), torch.stack([zero, side / h, (y0 + y1) / h - 1], -1)], 1)
    grid = F.affine_grid(theta, (len(boxes), 1, size, size), align_corners=False)
    return F.grid_sample(x, grid, align_corners=False).round().byte().permute(0, 2, 3, 1)


def drawn_bank(path, net, device, limit):
    """Bank of the drawn things, the photographs, and each thing's photograph; `net`: file of net_masks.py."""
    z, made = np.load(path), np.load(net)
    bits, fits = (made[k + os.path.basename(path)[:-4]] for k in ("bits_", "iou_"))
    photos, masks, thing = decode(z), decode(z, "mask", "mask_at", "L"), z["thing"]
    wanted, keep, pics, nets = set(few(len(thing), limit).tolist()), [], [], []
    for p in range(len(photos)):
        label = torch.tensor(masks[p], device=device)
        rows, boxes = [], []
        for k in np.nonzero(thing[:, 0] == p)[0]:
            ys, xs = np.nonzero(masks[p] == thing[k, 1])
            if k in wanted and len(ys) >= 40:
                rows.append(k)
                boxes.append((xs.min(), ys.min(), xs.max() + 1, ys.max() + 1))
        if not rows:
            continue
        h, w = photos[p].shape[:2]
        small = [min(128, math.ceil(v * 128 / max(h, w))) for v in (h, w)]
        theirs = torch.from_numpy(np.unpackbits(bits[rows], axis=-1)[:, :, : small[0], : small[1]]).to(device).float() * 255
        both = torch.cat([(label == torch.from_numpy(thing[rows, 1]).to(device).view(-1, 1, 1))[:, None] * 255.0,
                          F.interpolate(theirs, (h, w), mode="bilinear")], 1)
        m = windows(both, boxes, DRAWN, CONTEXT)
        rgb = windows(torch.tensor(photos[p], device=device).permute(2, 0, 1), boxes, DRAWN, CONTEXT)
        keep += rows
        pics.append(torch.cat([rgb, m[..., :1]], -1))
        nets.append(m[..., 1:].permute(0, 3, 1, 2))
    cls = torch.from_numpy(thing[keep, 2].astype(np.int64))
    bank = Bank("drawn", torch.cat(pics), cls, torch.ones(len(cls)), torch.ones(len(cls), dtype=torch.bool))
    bank.net = torch.cat(nets)
    bank.net_fits = torch.from_numpy(fits[keep] >= 0.4).to(device) & ((bank.net > 127).flatten(2).sum(-1) > 40)
    return bank, photos, torch.from_numpy(thing[keep, 0])


class Cuts(Pictures):
    """Batches of cuts of four banks, with what the teachers said of each."""

    def __init__(self, pack, salient, net_masks, prepared, device, seed, limit):
        self.device, self.gen = device, torch.Generator(device=device).manual_seed(seed)
        at = lambda n: os.path.join(pack, n)
        words = np.load(at("words.npz"))
        drawn, rooms, self.room = drawn_bank(at("drawn.npz"), net_masks, device, limit)
        z = np.load(at("photos.npz"))
        pick, whole = few(len(z["label"]), limit), decode(z)
        pics = stacked(lambda i: letterbox(whole[i], PHOTO), pick)
        photos = self.outlined("photos", salient, prepared, pics, z["label"][pick], torch.tensor(SOURCES)[torch.from_numpy(z["source"][pick].astype(np.int64))])
        z = np.load(at("things.npz"))
        of = {str(n): int(c) for n, c in zip(words["thing_names"], words["things"])}
        pics = stacked(lambda a: letterbox(a, THING), decode(z, mode="RGBA")[:limit])
        cls = torch.tensor([of[str(z["names"][n])] for n in z["name"][:limit]])
        shapes = Bank("shapes", pics, cls, torch.ones(len(cls)), torch.ones(len(cls), dtype=torch.bool))
        z = np.load(at("wild.npz"))
        wild, rng, boxes = decode(z), np.random.default_rng(seed=70), []
        for p, c, score, *box in z["found"]:
            boxes.append((wild[int(p)], int(c) if score > 0.55 else UNKNOWN, box, -1))
        for k, a in enumerate(wild + rooms):
            for _ in range(4):
                side = rng.uniform(0.2, 0.75) * min(a.shape[:2])
                x, y = rng.uniform(0, a.shape[1] - side), rng.uniform(0, a.shape[0] - side)
                boxes.append((a, UNKNOWN, (x, y, x + side, y + side), k - len(wild)))
        boxes = [boxes[i] for i in few(len(boxes), limit)]
        pics, at_photo = [], 0
        while at_photo < len(boxes):  # runs of one photograph together
            a, end = boxes[at_photo][0], at_photo
            while end < len(boxes) and boxes[end][0] is a:
                end += 1
            pics.append(windows(torch.tensor(a, device=device).permute(2, 0, 1), [b[2] for b in boxes[at_photo:end]], 208, 0.12))
            at_photo = end
        wild = self.outlined("wild", salient, prepared, torch.cat(pics), np.array([b[1] for b in boxes]), torch.ones(len(boxes)))
        self.banks, self.window_of = [drawn, photos, shapes, wild], torch.tensor([b[3] for b in boxes])

    def outlined(self, name, salient, prepared, pics, cls, weight):
        """A bank of pictures under the outlines of the salient-object network, or whole where it found none."""

        def find():
            mask, fine = outlines(salient(), pics)
            return [np.packbits(mask.cpu().numpy() > 127, axis=-1), fine.cpu().numpy()]

        bits, fine = prepared.arrays("outlines_" + name, find)
        mask, fine = (torch.from_numpy(v).to(self.device) for v in (np.unpackbits(bits, axis=-1) * 255, fine))
        pics = pics.to(self.device)
        mask = torch.where(fine[:, None, None], mask, (pics.amax(-1) > 0).byte() * 255)
        return Bank(name, torch.cat([pics, mask[..., None]], -1), torch.from_numpy(cls.astype(np.int64)), weight.float(), fine)

    @torch.no_grad()
    def ask(self, prepared, first, lite2):
        """Each bank's `first` [N,384], the mean of several views, and `opinion` [N,1000]: what the teachers say."""

        def say(bank):
            out = []
            for part in torch.arange(len(bank.cls)).split(256):
                w, said, logits = bank.pics[part].to(self.device), 0, 0
                with torch.autocast(KIND, dtype=torch.bfloat16):
                    for dim, margin, weight in VIEWS:
                        x = normalised(exact(w, dim, margin))
                        for view in (x, x.flip(-1)):
                            said = said + weight * first(view)
                            logits = logits + (lite2._fc(lite2.head(view)).float() / 4 if dim else 0)
                # In 8 bits, and of the thousand the likeliest: the rest share what is left.
                top, which = logits.softmax(-1).topk(TOP, -1)
                out.append([v.cpu().numpy() for v in ((F.normalize(said, dim=-1) * 400).round().clamp(-127, 127).to(torch.int8), top.half(), which.short())])
            return [np.concatenate(v) for v in zip(*out)]

        for b in self.banks:
            first_said, top, which = (torch.from_numpy(v).to(self.device) for v in prepared.arrays("said_" + b.name, lambda: say(b)))
            b.first, top = F.normalize(first_said.float(), dim=-1).half(), top.float()
            rest = ((1 - top.sum(1, keepdim=True)) / (1000 - TOP)).clamp(min=1e-7)
            b.opinion = rest.expand(-1, 1000).scatter(1, which.long(), top).clamp(min=1e-7).log().half()

    def ready(self, withheld):
        """Pictures go to the device; those of withheld classes, and windows of photographs of such, are never drawn."""
        drawn = self.banks[0].cls
        rooms = self.room[((drawn >= 0) & withheld.cpu()[drawn.clamp(min=0)])]
        self.banks[3].weight[torch.isin(self.window_of, rooms)] = 0
        for b in self.banks:
            b.pics, b.cls, b.outlined = b.pics.to(self.device), b.cls.to(self.device), b.outlined.to(self.device)
            weight = b.weight.to(self.device)
            named = b.cls >= 0
            c = b.cls.clamp(min=0)
            if b.name in ("drawn", "shapes"):
                weight = torch.where(named, torch.bincount(c)[c].float() ** -0.5, torch.zeros_like(weight))
            b.weight = torch.where(named & withheld[c], torch.zeros_like(weight), weight)

    def spoil(self, mask):
        """As Pictures.spoil; a fifth of the masks also takes in a piece of what is beside the thing."""
        out = super().spoil(mask)
        B, _, R, _ = mask.shape
        g = torch.linspace(-1, 1, R, device=self.device)
        x, y = g.view(1, 1, 1, R), g.view(1, 1, R, 1)
        area = out.sum((2, 3), keepdim=True).clamp(min=1)
        cx, cy = (out * x).sum((2, 3), keepdim=True) / area, (out * y).sum((2, 3), keepdim=True) / area
        sx, sy = (((out * (v - c) ** 2).sum((2, 3), keepdim=True) / area).sqrt() for v, c in ((x, cx), (y, cy)))
        u = lambda: self.u(B, 1, 1, 1)
        a, p = u() * 2 * math.pi, 2 + u() * 5
        far, rx, ry = 1.2 + u() * 0.9, sx * (0.4 + u() * 1.3), sy * (0.4 + u() * 1.3)
        more = ((((x - cx - far * sx * a.cos()) / rx).abs() ** p + ((y - cy - far * sy * a.sin()) / ry).abs() ** p) < 1).float()
        return torch.where(u() < 0.2, torch.maximum(out, more), out)

    @torch.no_grad()
    def batch(self, sizes):
        """Pictures [B,3,S,S] as the tower sees them and clean, masks, classes, the teachers' words, trust in them."""
        parts = []
        for b, n, blob_share, paste_share in zip(self.banks, sizes, (0.0, 0.2, 0.0, 0.25), (0.03, 0.1, 0.25, 0.0)):
            pick = self.pick(b.weight, n)
            x = b.pics[pick].permute(0, 3, 1, 2).float() / 255
            mask, R = x[:, 3:], x.shape[-1]
            blob = self.u(n, 1, 1, 1) < torch.where(b.outlined[pick], blob_share * 0.5, 2.0 * blob_share).view(-1, 1, 1, 1)
            mask = torch.where(blob, self.blob(n, R) * (x[:, :3].amax(1, keepdim=True) > 0), mask)
            whole = ~b.outlined[pick].view(-1, 1, 1, 1) & ~blob & (self.u(n, 1, 1, 1) < 0.5)
            mask = torch.where(whole, mask, self.spoil(mask))
            if b.name == "drawn":
                level = (self.u(n) < 0.4).long()
                use = b.net_fits[pick, level] & (self.u(n) < 0.5)
                mask = torch.where(use.view(-1, 1, 1, 1), (b.net[pick, level][:, None] > 127).float(), mask)
            dim = self.u(n) < 0.12
            rgb, m = self.cut(x[:, :3], mask, dim)
            trust = torch.where(blob.view(-1), 0.4, 1.0)
            parts.append((rgb, m, b.cls[pick], dim, self.u(n) < paste_share, b.first[pick], b.opinion[pick], trust))
        x, m, cls, dim, paste, first, opinion, trust = (torch.cat(p) for p in zip(*parts))
        drawn = self.banks[0].pics
        other = drawn[torch.randint(0, len(drawn), (len(x),), device=self.device, generator=self.gen)]
        other = F.interpolate(other[..., :3].permute(0, 3, 1, 2).float() / 255, (SIDE, SIDE), mode="bilinear")
        soft = F.avg_pool2d(m, 3, 1, 1)
        seen = self.recolour(self.soften(torch.where(paste.view(-1, 1, 1, 1), other * (1 - soft) + x * soft, x)))
        share = torch.where(dim, DIM + (self.u(len(x)) - 0.5) * 0.2, torch.zeros(1, device=self.device)).view(-1, 1, 1, 1)
        return seen * (m + (1 - m) * share), x, m, cls, first.float(), opinion.float(), trust


class Student:
    def __init__(self, recipe, tower, device, heat):
        self.name, (self.lr, self.hold, self.kd, self.unseen) = recipe, RECIPES[recipe]
        self.tower = tower
        self.scale = nn.Parameter(torch.tensor([math.log(36.0), math.log(36.0)], device=device))
        early, late = [], []
        for n, p in tower.body.named_parameters():
            deep = n.startswith(("_conv_head", "_bn1")) or n.startswith("_blocks.") and int(n.split(".")[1]) >= 13
            (late if deep else early).append(p)
        self.opt = torch.optim.AdamW([{"params": early, "k": 0.25, "weight_decay": 0.01}, {"params": late, "k": 0.6, "weight_decay": 0.01},
                                      {"params": [*tower.out.parameters(), self.scale], "k": 1.2, "weight_decay": 0.0}], lr=self.lr, betas=(0.9, 0.99))
        state = tower.state_dict()
        self.ema = {k: v.detach().clone() for k, v in state.items()}
        names = [k for k, v in state.items() if v.is_floating_point()]
        self.live, self.kept = [state[k] for k in names], [self.ema[k] for k in names]
        self.heat, self.step, self.sums, self.n = heat, 0, torch.zeros(6, device=device), 0

    def update(self, loss, parts, t):
        for group in self.opt.param_groups:
            group["lr"] = self.lr * group["k"] * min(1, (self.step + 1) / self.heat) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * min(t, 1))))
        self.opt.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.tower.parameters(), 2.0)
        if torch.isfinite(norm):
            self.opt.step()
        with torch.no_grad():
            torch._foreach_lerp_(self.kept, self.live, 1 - min(0.998, (self.step + 1) / (self.step + 10)))
        self.sums += torch.stack([p.detach() for p in parts])
        self.n, self.step = self.n + 1, self.step + 1

    def train(self):
        self.tower.train()
        for m in self.tower.modules():
            if isinstance(m, nn.BatchNorm2d):
                m.eval()


def main():
    ap = argparse.ArgumentParser()
    for name in ["pack", "net", "image", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--salient", help="folder of the salient-object network; only to prepare")
    ap.add_argument("--seconds", type=float, default=400)
    ap.add_argument("--withhold", action="store_true")
    ap.add_argument("--batch", type=int, nargs=4, default=[120, 112, 24, 72], help="drawn, photographs, shapes, without labels")
    ap.add_argument("--seed", type=int, default=80)
    ap.add_argument("--prepared", help="folder of what --prepare made")
    ap.add_argument("--prepare", action="store_true", help="make the files of --prepared, and end")
    ap.add_argument("--limit", type=int, help="so many rows of each bank, to try the program")
    ap.add_argument("--name", default="")
    ap.add_argument("--recipes", nargs="+", choices=list(RECIPES), default=list(RECIPES), help="one alone has twice the steps of two")
    ap.add_argument("--marks", type=float, nargs="*", default=[0.15, 0.3, 0.45, 0.6, 0.75, 0.9], help="shares of the time at which the tower is measured")
    args = ap.parse_args()
    device = torch.device(KIND)
    torch.manual_seed(args.seed)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    start = time.time()
    os.makedirs(args.out, exist_ok=True)
    out_at = lambda n: os.path.join(args.out, (args.name + "_" if args.name else "") + n)
    log = open(out_at("open.jsonl"), "w")

    def note(**row):
        log.write(json.dumps(row) + "\n")
        log.flush()

    tell = lambda *what: print(f"[{args.name} {time.time() - start:.0f}s]", *what, flush=True)
    at = lambda n: os.path.join(args.pack, n)
    z = np.load(at("words.npz"))
    get = lambda n: torch.from_numpy(z[n]).to(device)
    tw, canon, truth_of = F.normalize(get("embed").float(), dim=-1), F.normalize(get("canon").float(), dim=-1), get("truth")
    own, colour_at, everyday = get("own").long(), get("colours").long(), get("everyday").long()
    thousand = own[get("thousand").long()]
    own_words, own_of = torch.unique(own, return_inverse=True)
    index = {str(w): i for i, w in enumerate(z["words"])}
    listed = torch.tensor(sorted(index[w] for w in withheld_words() if w in index), device=device)
    tell("withheld words without an entry:", [w for w in withheld_words() if w not in index])
    open_class = (truth_of[: len(own)][:, listed] == 1).any(1) | torch.isin(own, listed)

    # Pictures, and what the teachers say of them.
    prepared = Prepared(args.prepared, args.prepare)
    salient = lambda: Salient(args.salient, device, torch.float16 if KIND == "cuda" else torch.float32)
    cuts = Cuts(args.pack, salient, args.net, prepared, device, args.seed + 1, args.limit)
    tell("outlines:", {b.name: (len(b.cls), int(b.outlined.sum())) for b in cuts.banks})
    lite2 = lite2_of(at("lite2.npz")).to(device).eval().requires_grad_(False).to(memory_format=torch.channels_last)
    fc, shipped = lite2._fc, folded(args.image)
    flat = lambda: fold(ImageTower()).to(device).eval().requires_grad_(False).to(memory_format=torch.channels_last)
    first = flat()
    first.load_state_dict(shipped)
    cuts.ask(prepared, first, lite2)
    tell("asked the teachers")
    if args.prepare:
        return

    # Sets to measure on: held-out things, things and photographs of withheld classes, held-out whole photographs.
    g = torch.Generator().manual_seed(5)
    held, _, _ = drawn_bank(at("drawn_held.npz"), args.net, device, args.limit)
    held = held.only(held.cls >= 0)
    opened = open_class.cpu()
    is_open = lambda b: (b.cls >= 0) & opened[b.cls.clamp(min=0)]  # still on the CPU, as all classes are
    opens = [b.only(is_open(b)) for b in (cuts.banks[0], held)]
    joined = lambda two: [torch.cat(v) for v in zip(*two)]
    photos = cuts.banks[1]
    rows = torch.nonzero(is_open(photos) & photos.outlined.cpu())[:, 0]
    rows = rows[torch.randperm(len(rows), generator=g)]
    seen_of, some = {}, []
    for r in rows.tolist():
        c = int(photos.cls[r])
        seen_of[c] = seen_of.get(c, 0) + 1
        if seen_of[c] <= 30:
            some.append(r)
    zh = np.load(at("held.npz"))
    whole = stacked(lambda a: letterbox(a, SIDE), decode(zh)[: args.limit])
    sets = {
        "held-out things": (held.pics, held.cls, 0.0, 0.0),
        "held-out things, network's masks": (*held.under_net(), 0.0, 0.0),
        "open things": (*joined([(b.pics, b.cls) for b in opens]), 0.0, 0.0),
        "open things, network's masks": (*joined([b.under_net() for b in opens]), 0.0, 0.0),
        "open photographs, cut": (photos.pics[some], photos.cls[some], 0.0, 0.0),
        "open photographs, box": (photos.pics[some], photos.cls[some], 1.0, 0.08),
        "held-out photographs": (F.pad(whole, (0, 1), value=255), torch.from_numpy(zh["label"][: args.limit].astype(np.int64)), 1.0, 0.0),
    }
    sets = {k: ((exact(x, dim, margin) * 255).byte().to(device), c.to(device)) for k, (x, c, dim, margin) in sets.items() if len(c)}
    tell("sets:", {k: len(c) for k, (_, c) in sets.items()}, "withheld classes", int(open_class.sum()))

    @torch.no_grad()
    def measure(model):
        torch.backends.cudnn.benchmark = False
        out = {}
        for name, (x, c) in sets.items():
            with torch.autocast(KIND, dtype=torch.bfloat16):
                f = torch.cat([model(normalised(p.float() / 255)) for p in x.split(256)]).float()
            floor, mine = (f @ canon.T).amax(1), (f * tw[own[c]]).sum(1)
            t, s = truth_of[c][:, everyday], f @ tw[everyday].T
            false = (s - floor[:, None])[t == 0]
            shift = false.kthvalue(max(1, int(len(false) * (1 - ABSENT)))).values
            right = (t.gather(1, s.argmax(1)[:, None])[:, 0] != 0) | (mine >= s.amax(1))
            among = (f @ tw[own_words].T).argmax(1) == own_of[c]
            r = lambda v: round(float(v.float().mean()), 4)
            out[name] = {"found": r(mine >= floor), "absent": r(false >= 0), "found at 1.5 %": r(mine >= floor + shift), "shift": r(shift), "right": r(right), "top1": r(among)}
        torch.backends.cudnn.benchmark = True
        return out

    def said(tag, figures):
        tell(tag, json.dumps({k: list(v.values()) for k, v in figures.items()}))
        note(tag=tag, figures=figures)

    said("shipped", measure(first))
    withheld = open_class if args.withhold else torch.zeros_like(open_class)
    cuts.ready(withheld)

    # How often each class is drawn; a word is seen where it is true of a class that is.
    mass = torch.zeros(len(own), device=device)
    for b, n in zip(cuts.banks, args.batch):
        named = b.cls >= 0
        share = b.weight / b.weight.sum() * n / sum(args.batch)
        mass.index_add_(0, b.cls[named], share[named])
    seen_class = mass > 1e-6
    prior = torch.zeros(len(own_words), device=device).index_add_(0, own_of, mass)
    log_prior = prior.clamp(min=1e-6).log() - prior.clamp(min=1e-6).log().mean()
    seen_own = prior > 1e-6
    seen_word = ((truth_of[: len(own)] == 1) & (mass[:, None] > 2e-4)).any(0)
    tell("classes seen", int(seen_class.sum()), "words seen", int(seen_word.sum()), "of", len(tw))

    with torch.no_grad():
        sample = normalised(cuts.batch([k * (3 if KIND == "cuda" else 1) for k in args.batch])[0])
    students = []
    for recipe in args.recipes:
        tower = ImageTower().to(device)
        unfold(tower, shipped, lite2, 0.0, sample)
        tower.requires_grad_(True)
        students.append(Student(recipe, tower.to(memory_format=torch.channels_last), device, 120))
    del sample

    def blended(states, share):
        """The tower `share` of the way from the shipped one to the mean of `states`."""
        with torch.no_grad():
            mean = None
            for s in states:
                tower = ImageTower().to(device)
                tower.load_state_dict(s)
                now = fold(tower.eval()).state_dict()
                mean = now if mean is None else {k: mean[k] + now[k] for k in now}
            model = flat()
            model.load_state_dict({k: shipped[k].to(device) + share * (v / len(states) - shipped[k].to(device)) for k, v in mean.items()})
        return model

    def save(s, name):
        torch.save({"tower." + k: v.half().cpu() for k, v in s.ema.items()}, out_at(name + ".tmp"))
        os.rename(out_at(name + ".tmp"), out_at(name))

    def losses(s, batch):
        x, clean, mask, cls, target, opinion, trust = batch
        with torch.autocast(KIND, dtype=torch.bfloat16):
            features = s.tower.body.head(normalised(x))
            f = s.tower.embed(features)
            k = torch.randint(0, 1000, (256,), device=device)
            base = features.detach()[torch.randint(0, len(features), (256,), device=device)].float()
            push = 6 + 8 * torch.rand(256, 1, device=device)
            made_f = s.tower.embed((0.6 * base + push * fc.weight[k] / fc.weight[k].square().sum(1, keepdim=True)).clamp(min=0))
            logits = fc(features).float()
        sc = s.scale.exp()
        named, c = (cls >= 0).float(), cls.clamp(min=0)
        cos, want, truth = f @ tw.T, own_of[c], truth_of[c].clone()
        # Which of the names that were seen, frequencies taken out.
        other = (truth[:, own_words] != 0) & ~F.one_hot(want, len(own_words)).bool()
        ce_logits = (sc[0] * cos[:, own_words] + log_prior).masked_fill(other | ~seen_own, -1e4)
        ce = (F.cross_entropy(ce_logits, want, reduction="none") * named).sum() / named.sum()
        # The product's question: does a word beat the canon?
        margin = (cos - (f @ canon.T).amax(1, keepdim=True)) * sc[1].clamp(max=40)
        order = torch.arange(len(cls), device=device)
        is_cut = (order < args.batch[0]) | ((order >= sum(args.batch[:2])) & (order < sum(args.batch[:3])))
        truth[:, colour_at] = torch.where(is_cut[:, None], dominant_colour(clean, mask), -1).to(truth.dtype)
        pos, neg = (truth == 1).float(), (truth == 0).float() * torch.where(seen_word, 1.0, s.unseen)
        itself = F.one_hot(own_words[want], pos.shape[1]) * pos
        rest = pos - itself
        p_loss = (F.softplus(-margin) * (itself + rest / rest.sum(1, keepdim=True).clamp(min=1))).sum(1) / 2
        near = neg * (margin.detach().sigmoid() + 0.01)
        n_loss = (F.softplus(margin) * near).sum(1) / near.sum(1).clamp(min=1e-3)
        bce = ((2 * p_loss + 1.5 * n_loss) * named).sum() / named.sum()
        # The teachers: less where they did not know a name that is known.
        with torch.no_grad():
            p = (opinion / 1.5).softmax(-1)
            sure = opinion.softmax(-1).amax(1)
            knew = ((target * tw[own_words[want]]).sum(1) - (target @ canon.T).amax(1)) * 20
            w_hold = torch.where(named > 0, 0.05 + 0.5 * knew.sigmoid(), torch.ones_like(knew)) * trust
            agrees = (p * (truth_of[c][:, thousand] != 0)).sum(1)
            w_kd = torch.where(named > 0, agrees, sure) * trust
        hold = (w_hold * (1 - (f * target).sum(1))).sum() / len(cls)
        kl = lambda q: F.kl_div(q.log_softmax(-1), p, reduction="none").sum(-1)
        kd = (w_kd * (kl(sc[0] * cos[:, thousand]) + 0.5 * kl(logits / 1.5))).mean()
        made_cos = made_f @ tw[thousand].T
        made_margin = made_cos.gather(1, k[:, None])[:, 0] - (made_f @ canon.T).amax(1)
        made = F.cross_entropy(sc[0] * made_cos, k) + F.softplus(-made_margin * sc[1].clamp(max=40)).mean()
        loss = ce + bce + s.hold * hold + s.kd * kd + 0.2 * made
        return loss, [loss, ce, bce, hold, kd, made]

    tell("ready")
    begin, saved, step, marks = time.time(), time.time(), 0, list(args.marks)
    torch.backends.cudnn.benchmark = True
    while True:
        t = (time.time() - begin) / args.seconds
        if t >= 1:
            break
        batch = cuts.batch(args.batch)
        for s in students:
            s.train()
            s.update(*losses(s, batch), t)
        step += 1
        if step == 1:
            # The library has chosen its algorithms: what came before is no training.
            tell(f"first step done, {time.time() - begin:.0f} s after the beginning")
        if time.time() - saved > SAVE_EVERY:
            saved = time.time()
            for s in students:
                save(s, s.name + ".pt")
        if step % (50 if KIND == "cuda" else 1) == 0:
            for s in students:
                v = [round(x, 4) for x in (s.sums / s.n).tolist()]
                tell(f"step {step} {s.name}: loss, ce, bce, hold, kd, made {v} scale {float(s.scale[0].detach().exp()):.1f}")
                note(step=step, recipe=s.name, seconds=round(time.time() - begin, 1), losses=v)
                s.sums.zero_()
                s.n = 0
        if marks and t > marks[0]:
            mark = marks.pop(0)
            for s in students:
                for share in (0.4, 1.0):
                    said(f"{s.name} at {mark:.2f} share {share}", measure(blended([s.ema], share)))
                if 0.4 < mark < 0.5:
                    save(s, s.name + "_middle.pt")
    for s in students:
        save(s, s.name + ".pt")
    for names in [[r] for r in args.recipes] + [args.recipes] * (len(args.recipes) > 1):
        for share in (0.2, 0.35, 0.5, 0.65, 0.8, 1.0):
            said(f"{'+'.join(names)} end share {share}", measure(blended([s.ema for s in students if s.name in names], share)))
    tell("trained", step)


if __name__ == "__main__":
    main()
