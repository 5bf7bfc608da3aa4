"""Trains the image tower to name things in whole photos, its features pooled under their masks, and from cuts as before.

    python train_pooled.py --pack PACK --out OUT --seconds S [--smoke]

It starts from the bundle's tower, batch norm folded, and moves little: a small learning rate, the mean of its weights, and
for every mask of a photo, named or not, the tower that training begins with says what to keep. That teacher looks at a
thing four ways (cut on black, plain box, whole photo at two sizes, each and its mirror image), and the mean of these names
better than any of them. The student sees the photo turned, scaled, recoloured, with cut-outs of other things pasted over it,
or a mosaic of class-labelled photographs, under masks as a network draws them. It learns from the cut, from the whole photo and from the
sum of both, since the product asks the sum. What is not labelled is never a negative for a name, and a word that
no picture shows is hardly ever taught as false.

Judge: pooled_judge.py, about every 150 s, on the mean weights, the whole way and half the way from the start. OUT gets last.pt, half.pt,
best.pt (`open` and `scenes`, both) and pooled.jsonl. Names of withheld.txt are not in training.
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

from augment import Augment
from pooled_judge import KIND, NAMES, Judge, decode, table, tower_of
from pooled_masks import Everything
from pooled_photos import AREA, STORE, Canvases, Photos, class_labelled
from towers import STRIDE, normalised
from words_model import SIDE

LR = 1e-4
# Of what is learnt: weights of the whole photo, of the cut, of their sum; of what the teacher says; of false words that no set shows.
PATHS, HOLD, UNSEEN = (1.0, 0.7, 0.5), 14.0, 0.1
CUTS, WHOLES = 112, 48
JUDGED_EVERY, SAVED_EVERY = 150, 60
TEACHER = (1.0, 0.35, 0.8, 0.8)  # cut, plain box, whole photo at 448 and at 576
END = 45  # seconds that are kept for the last judgement


def autocast():
    return torch.autocast("cuda", dtype=torch.bfloat16, enabled=KIND == "cuda")


class Words:
    """Embeddings of words and what is true of each class."""

    def __init__(self, pack, device):
        z = np.load(os.path.join(pack, "words.npz"))
        get = lambda n: torch.from_numpy(z[n]).to(device)
        self.text, self.canon = F.normalize(get("embed").float(), dim=-1), F.normalize(get("canon").float(), dim=-1)
        self.truth, self.own, self.withheld = get("truth"), get("own").long(), z["withheld"]
        self.own_words, self.own_of = torch.unique(self.own, return_inverse=True)
        self.mass = torch.zeros(len(self.own), device=device)

    def show(self, cls):
        """Counts the classes of a batch: what is seen, and how often."""
        now = torch.bincount(cls[cls >= 0], minlength=len(self.own)).float()
        self.mass.mul_(0.998).add_(now)
        prior = torch.zeros(len(self.own_words), device=now.device).index_add_(0, self.own_of, self.mass)
        self.seen_own = prior > 0
        prior = prior / prior.sum() + 1e-5
        self.log_prior = prior.log() - prior.log().mean()

    def settle(self, seen):
        """Words that are true of a class in training; others are hardly ever taught as false."""
        self.seen_word = (self.truth[: len(self.own)][seen] == 1).any(0)


@torch.no_grad()
def teach_things(tower, photos, step=96):
    """What the tower says of each thing of the photos: unit [N,384], half precision."""
    t, out = photos.things, torch.zeros(len(photos.things), 384, device=photos.things.device)
    for rows in torch.arange(len(t), device=t.device).split(step):
        p, n, _, _, x0, y0, x1, y1 = t[rows, :8].T
        x = photos.pics[p].permute(0, 3, 1, 2).float() / 255
        m = (photos.labels[p] == n.view(-1, 1, 1))[:, None].float()
        side, zero = torch.maximum(x1 - x0, y1 - y0).float(), torch.zeros(len(p), device=t.device)
        for margin, dim, weight in ((0.0, 0.0, TEACHER[0]), (0.08, 1.0, TEACHER[1])):
            k = side * (1 + 2 * margin) / STORE
            theta = torch.stack([torch.stack([k, zero, (x0 + x1) / STORE - 1], -1), torch.stack([zero, k, (y0 + y1) / STORE - 1], -1)], 1)
            both = F.grid_sample(torch.cat([x, m], 1), F.affine_grid(theta, (len(p), 4, SIDE, SIDE), align_corners=False), align_corners=False)
            inside = (both[:, 3:] > 0.5).float()
            view = normalised(both[:, :3] * (inside + (1 - inside) * dim))
            with autocast():
                out[rows] += weight / 2 * (tower.cut(view) + tower.cut(view.flip(-1)))
    order = torch.argsort(t[:, 0], stable=True)
    count = torch.bincount(t[:, 0], minlength=len(photos.pics))
    rows_of = dict(enumerate(order.split(count.tolist())))
    for weight, side in ((TEACHER[2], 448), (TEACHER[3], 576)):
        groups = {}
        for i, (h, w) in enumerate(photos.size.int().tolist()):
            if count[i] and len(rows_of[i]):
                groups.setdefault(tuple(max(1, round(v * side / STORE / STRIDE)) for v in (h, w)), []).append((i, h, w))
        for cells, members in groups.items():
            size = tuple(v * STRIDE for v in cells)
            for a in range(0, len(members), 24):
                some = members[a : a + 24]
                x = torch.cat([F.interpolate(photos.pics[i : i + 1, :h, :w].permute(0, 3, 1, 2).float() / 255, size, mode="bilinear", antialias=True) for i, h, w in some])
                rows = torch.cat([rows_of[i] for i, _, _ in some])
                of = torch.repeat_interleave(torch.arange(len(some), device=x.device), torch.tensor([len(rows_of[i]) for i, _, _ in some], device=x.device))
                weights = torch.cat([F.adaptive_avg_pool2d((photos.labels[i, :h, :w][None] == t[rows_of[i], 1].view(-1, 1, 1)).float()[:, None], cells)[:, 0] for i, h, w in some])
                with autocast():
                    view = normalised(x)
                    out[rows] += weight / 2 * (tower.pooled(view, of, weights) + tower.pooled(view.flip(-1), of, weights.flip(-1)))
    return F.normalize(out, dim=-1).half()


@torch.no_grad()
def teach_tiles(tower, tiles, size, step=256):
    """The same of class-labelled photographs, whole."""
    out = []
    for x, s in zip(tiles.split(step), size.split(step)):
        x = x.permute(0, 3, 1, 2).float() / 255
        S = x.shape[-1]
        k, zero = s.amax(1) / S, torch.zeros(len(s), device=x.device)
        theta = torch.stack([torch.stack([k, zero, s[:, 1] / S - 1], -1), torch.stack([zero, k, s[:, 0] / S - 1], -1)], 1)
        view = normalised(F.grid_sample(x, F.affine_grid(theta, (len(x), 3, SIDE, SIDE), align_corners=False), align_corners=False))
        with autocast():
            out.append(F.normalize(tower.cut(view) + tower.cut(view.flip(-1)), dim=-1).half())
    return torch.cat(out)


def outlined(pack, device, limit):
    """Index pictures of photographs without outlines, by the bundle's mask network: {set:key: u8 [h,w]}."""
    net, out = Everything(pack, device), {}
    with np.load(os.path.join(pack, "photos_coco_unlabelled.npz")) as z:
        z = {k: z[k] for k in z.files}
    for p in range(len(z["key"]))[:: max(1, len(z["key"]) // limit) if limit else 1]:
        out[f"coco_unlabelled:{z['key'][p]}"] = net.label(decode(z["blob"], z["offsets"], p))
    return out


class Student:
    def __init__(self, tower, device, heat=150):
        self.tower, self.heat, self.step = tower.requires_grad_(True).train(), heat, 0
        self.scale = nn.Parameter(torch.tensor([math.log(36.0), math.log(36.0)], device=device))
        deep = lambda n: n.startswith("_conv_head") or n.startswith("_blocks.") and int(n.split(".")[1]) >= 13
        body = list(tower.body.named_parameters())
        self.opt = torch.optim.AdamW([
            {"params": [p for n, p in body if not deep(n)], "k": 0.25},
            {"params": [p for n, p in body if deep(n)], "k": 0.6},
            {"params": [*tower.out.parameters(), *tower.near.parameters(), self.scale], "k": 1.2},
        ], lr=LR, betas=(0.9, 0.99), weight_decay=0.0)
        self.live = list(tower.state_dict().values())
        self.mean = {k: v.detach().clone() for k, v in tower.state_dict().items()}

    def update(self, loss, t):
        for group in self.opt.param_groups:
            group["lr"] = LR * group["k"] * min(1, (self.step + 1) / self.heat) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * min(t, 1))))
        self.opt.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.tower.parameters(), 2.0)
        if torch.isfinite(norm):
            self.opt.step()
        with torch.no_grad():
            torch._foreach_lerp_(list(self.mean.values()), self.live, 1 - min(0.998, (self.step + 1) / (self.step + 10)))
        self.step += 1


def path_loss(f, cls, target, words, scale):
    """Losses of unit vectors [K,384]: which of the seen names; which words beat the canon; what the teacher says."""
    named, c = (cls >= 0).float(), cls.clamp(min=0)
    some = named.sum().clamp(min=1)
    sc = scale.exp()
    cos, want, truth = f @ words.text.T, words.own_of[c], words.truth[c]
    other = (truth[:, words.own_words] != 0) & ~F.one_hot(want, len(words.own_words)).bool()
    logits = (sc[0] * cos[:, words.own_words] + words.log_prior).masked_fill(other | ~words.seen_own, -1e4)
    ce = (F.cross_entropy(logits, want, reduction="none", label_smoothing=0.0) * named).sum() / some
    margin = (cos - (f @ words.canon.T).amax(1, keepdim=True)) * sc[1].clamp(max=40)
    pos, neg = (truth == 1).float(), (truth == 0).float() * torch.where(words.seen_word, 1.0, UNSEEN)
    itself = F.one_hot(words.own_words[want], pos.shape[1]) * pos
    rest = pos - itself
    p_loss = (F.softplus(-margin) * (itself + rest / rest.sum(1, keepdim=True).clamp(min=1))).sum(1) / 2
    near = neg * (margin.detach().sigmoid() + 0.01)
    n_loss = (F.softplus(margin) * near).sum(1) / near.sum(1).clamp(min=1e-3)
    bce = ((2 * p_loss + 1.5 * n_loss) * named).sum() / some
    with torch.no_grad():  # less where the teacher did not know a name that is known
        knew = ((target * words.text[words.own_words[want]]).sum(1) - (target @ words.canon.T).amax(1)) * 20
        trust = torch.where(named > 0, 0.05 + 0.5 * knew.sigmoid(), torch.ones_like(knew))
    hold = (trust * (1 - (f * target).sum(1))).mean()
    return ce + bce + HOLD * hold, torch.stack([ce, bce, hold]).detach()


def losses(student, canvases, words, said_things, said_tiles, area, n_cuts, n_wholes):
    b = canvases.batch(area)
    cut, at = canvases.cuts(b, n_cuts)
    whole, tiles = canvases.wholes(n_wholes)
    row, tile = b["row"].clamp(min=0), b["kind"] == 2
    target = torch.where(tile[:, None], said_tiles[row.clamp(max=len(said_tiles) - 1)], said_things[row.clamp(max=len(said_things) - 1)]).float()
    words.show(torch.cat([b["class"], canvases.tile_class[tiles]]))
    tower = student.tower
    with autocast():
        context = tower.pooled(normalised(b["canvas"]), b["of"], b["weights"])
        seen = tower.cut(normalised(torch.cat([cut, whole])))
    cls = torch.cat([b["class"][at], canvases.tile_class[tiles]])
    a, parts_a = path_loss(context, b["class"], target, words, student.scale)
    c, parts_c = path_loss(seen, cls, torch.cat([target[at], said_tiles[tiles].float()]), words, student.scale)
    both = F.normalize(context[at] + seen[: len(at)], dim=-1)
    s, parts_s = path_loss(both, b["class"][at], target[at], words, student.scale)
    return PATHS[0] * a + PATHS[1] * c + PATHS[2] * s, torch.cat([parts_a, parts_c, parts_s]), len(b["of"])


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True, help="of wall-clock in all, preparation and last judgement included")
    ap.add_argument("--smoke", action="store_true", help="a few steps on a tiny subset, to see that all works")
    ap.add_argument("--seed", type=int, default=39)
    args = ap.parse_args()
    begin, device = time.time(), torch.device(KIND)
    torch.manual_seed(args.seed)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    os.makedirs(args.out, exist_ok=True)
    log = open(os.path.join(args.out, "smoke.jsonl" if args.smoke else "pooled.jsonl"), "w")
    tell = lambda *what: print(f"[{time.time() - begin:.0f}s]", *what, flush=True)

    def note(**row):
        log.write(json.dumps({"seconds": round(time.time() - begin, 1), **row}) + "\n")
        log.flush()

    limit = (24 if KIND == "cuda" else 1) if args.smoke else 0
    words = Words(args.pack, device)
    extra = outlined(args.pack, device, limit)
    tell("outlined", len(extra), "photographs without labels, masks", sum(int(m.max()) for m in extra.values()))
    photos = Photos(args.pack, words.withheld, device, limit, extra)
    tell("photos", len(photos.pics), "things", len(photos.things), "with names", int((photos.things[:, 2] >= 0).sum()))
    tiles = class_labelled(args.pack, words.withheld, device, 64 if args.smoke else 0)
    canvases = Canvases(photos, tiles, Augment(device, args.seed + 1), device)
    tell("class-labelled", len(tiles[0]), "cut-outs", len(canvases.paste))
    first = tower_of(args.pack, device)
    said_things, said_tiles = teach_things(first, photos, 96 if KIND == "cuda" else 8), teach_tiles(first, tiles[0], tiles[1], 256 if KIND == "cuda" else 16)
    cls = torch.cat([photos.things[:, 2], tiles[2]])
    words.settle(torch.unique(cls[cls >= 0]))
    tell("the teacher has spoken; classes in training", len(torch.unique(cls)), "words", int(words.seen_word.sum()))
    judge = Judge(args.pack, device, limit=(60 if KIND == "cuda" else 6) if args.smoke else 0)
    tell("judge", {k: len(v) for k, v in judge.kinds.items()})

    def judged(title, tower):
        figures = judge.all(tower)
        table(f"[{time.time() - begin:.0f}s] {title}", figures)
        note(judge=title, figures=figures, columns=NAMES)
        return sum(figures["both 576"][k][i] for k, i in (("open", 0), ("open", 4), ("scenes", 0)) if k in figures["both 576"])

    tower = tower_of(args.pack, device)
    student, start = Student(tower, device), {k: v.clone() for k, v in first.state_dict().items()}
    best = judged("start", first)

    def mixed(share):
        t = tower_of(args.pack, device)
        t.load_state_dict({k: start[k] + share * (student.mean[k] - start[k]) for k in start})
        return t

    def save(name):
        path = os.path.join(args.out, name)
        torch.save({k: v.half().cpu() for k, v in student.mean.items()}, path + ".tmp")
        os.replace(path + ".tmp", path)

    area, n_cuts, n_wholes = (AREA, CUTS, WHOLES) if KIND == "cuda" else (4 * 448 * 448, 8, 4)
    stop = begin + args.seconds - (2 if args.smoke else END)
    trained_from, saved, next_judge, half = time.time(), time.time(), time.time() + JUDGED_EVERY, False
    sums, n = torch.zeros(9, device=device), 0
    torch.backends.cudnn.benchmark, torch.backends.cudnn.benchmark_limit = True, 3
    while time.time() < stop and not (args.smoke and student.step >= 4):
        t = (time.time() - trained_from) / (stop - trained_from)
        loss, parts, things = losses(student, canvases, words, said_things, said_tiles, area, n_cuts, n_wholes)
        student.update(loss, t)
        sums, n = sums + parts, n + 1
        if student.step in (1, 2, 10) or student.step % (100 if KIND == "cuda" else 2) == 0:
            v = [round(x, 3) for x in (sums / n).tolist()]
            tell(f"step {student.step} things {things} photo (ce, bce, hold) {v[:3]} cut {v[3:6]} both {v[6:]} scale {float(student.scale[0].detach().exp()):.1f}")
            note(step=student.step, losses=v)
            sums.zero_()
            n = 0
        if time.time() - saved > SAVED_EVERY:
            saved = time.time()
            save("last.pt")
        if not half and t > 0.5:
            half = True
            save("half.pt")
        if time.time() > next_judge and not args.smoke and time.time() < stop - 60:
            torch.backends.cudnn.benchmark = False
            judged(f"step {student.step} share 0.5", mixed(0.5))
            got = judged(f"step {student.step} share 1", mixed(1.0))
            torch.backends.cudnn.benchmark = True
            if got > best:
                best = got
                save("best.pt")
            save("last.pt")
            next_judge = time.time() + JUDGED_EVERY
    save("smoke.pt" if args.smoke else "last.pt")
    torch.backends.cudnn.benchmark = False
    for share in ((1.0,) if args.smoke else (1.0, 0.5, 0.75, 0.35)):
        if share == 1.0 or time.time() < begin + args.seconds - 10:
            judged(f"end, step {student.step} share {share}", mixed(share))
    tell("trained", student.step)


if __name__ == "__main__":
    main()
