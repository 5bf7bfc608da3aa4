"""Trains the image tower to name things in whole photos, its features pooled under their masks, and from cuts as before.

    python train_pooled.py --pack PACK --out OUT --seconds S [--without SET ...] [--smoke]

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
from losses import Steps, Words, mean_of, saved, which_name, which_words
from pictures import decoded
from pooled_judge import KIND, NAMES, Judge, table, tower_of
from pooled_masks import Everything
from pooled_photos import AREA, STORE, Canvases, Photos, class_labelled
from towers import STRIDE, normalised
from words_model import SIDE

LR = 1e-4
# Of what is learnt: weights of the whole photo, of the cut, of their sum; of what the teacher says; of false words that no set shows.
WAYS, HOLD, UNSEEN = (1.0, 0.7, 0.5), 14.0, 0.1
CUTS, WHOLES = 112, 48
JUDGED_EVERY, SAVED_EVERY = 150, 60
TEACHER = (1.0, 0.35, 0.8, 0.8)  # cut, plain box, whole photo at 448 and at 576
END = 45  # seconds that are kept for the last judgement


def autocast():
    return torch.autocast("cuda", dtype=torch.bfloat16, enabled=KIND == "cuda")


class Seen:
    """How often each name is shown, over the last thousand steps or so, and which words are true of a class in training."""

    def __init__(self, words, classes):
        self.words, self.mass = words, torch.zeros(len(words.own), device=words.own.device)
        true = (words.truth[: len(words.own)][classes] == 1).any(0)
        self.weight = torch.where(true, 1.0, UNSEEN)

    def show(self, cls):
        self.mass.mul_(0.998).add_(torch.bincount(cls[cls >= 0], minlength=len(self.mass)).float())
        prior = torch.zeros(len(self.words.own_words), device=cls.device).index_add_(0, self.words.own_of, self.mass)
        self.names = prior > 0
        prior = prior / prior.sum() + 1e-5
        self.log_prior = prior.log() - prior.log().mean()


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
        out[f"coco_unlabelled:{z['key'][p]}"] = net.label(decoded(z["blob"], z["offsets"], p))
    return out


class Student:
    """The tower that is trained, and what its losses are. Parts: names, words, teacher, of whole photos, of cuts, of their sum."""

    def __init__(self, tower, canvases, words, seen, said_things, said_tiles):
        self.tower, self.canvases, self.words, self.seen = tower.requires_grad_(True).train(), canvases, words, seen
        self.said_things, self.said_tiles = said_things, said_tiles
        device = words.own.device
        self.scale = nn.Parameter(torch.tensor([math.log(36.0), math.log(36.0)], device=device))
        deep = lambda n: n.startswith("_conv_head") or n.startswith("_blocks.") and int(n.split(".")[1]) >= 13
        body = list(tower.body.named_parameters())
        groups = [{"params": [p for n, p in body if not deep(n)], "k": 0.25}, {"params": [p for n, p in body if deep(n)], "k": 0.6},
                  {"params": [*tower.out.parameters(), *tower.near.parameters(), self.scale], "k": 1.2}]
        self.steps = Steps(tower, [{**g, "weight_decay": 0.0} for g in groups], LR, 150, 0.998)
        self.sums, self.n = torch.zeros(9, device=device), 0

    def step(self, t, area, cuts, wholes):
        loss, parts = self.losses(area, cuts, wholes)
        self.steps.take(loss, t)
        self.sums += parts
        self.n += 1

    def mean_losses(self):
        v = [round(x, 3) for x in (self.sums / self.n).tolist()]
        self.sums.zero_()
        self.n = 0
        return v

    def losses(self, area, cuts, wholes):
        b = self.canvases.batch(area)
        cut, at = self.canvases.cuts(b, cuts)
        whole, tiles = self.canvases.wholes(wholes)
        row, is_tile = b["row"], b["kind"] == 2
        of_tiles, of_things = (said[row.clamp(0, len(said) - 1)] for said in (self.said_tiles, self.said_things))
        target = torch.where(is_tile[:, None], of_tiles, of_things).float()
        tile_class = self.canvases.tile_class[tiles]
        self.seen.show(torch.cat([b["class"], tile_class]))
        with autocast():
            context = self.tower.pooled(normalised(b["canvas"]), b["of"], b["weights"])
            seen = self.tower.cut(normalised(torch.cat([cut, whole])))
        both = F.normalize(context[at] + seen[: len(at)], dim=-1)
        ways = [(context, b["class"], target), (seen, torch.cat([b["class"][at], tile_class]), torch.cat([target[at], self.said_tiles[tiles].float()])),
                (both, b["class"][at], target[at])]
        got = [self.of_vectors(*w) for w in ways]
        return sum(k * g[0] for k, g in zip(WAYS, got)), torch.cat([g[1] for g in got])

    def of_vectors(self, f, cls, target):
        """Of unit vectors [K,384]: which of the seen names; which words beat the canon; what the teacher says."""
        w, sc = self.words, self.scale.exp()
        named, c = (cls >= 0).float(), cls.clamp(min=0)
        cos, want, truth = f @ w.text.T, w.own_of[c], w.truth[c]
        ce = mean_of(which_name(cos, want, truth, w.own_words, sc[0], self.seen.log_prior, self.seen.names), named)
        margin = (cos - (f @ w.canon.T).amax(1, keepdim=True)) * sc[1].clamp(max=40)
        bce = mean_of(which_words(margin, truth, w.own_words[want], self.seen.weight), named)
        with torch.no_grad():  # less where the teacher did not know a name that is known
            knew = ((target * w.text[w.own_words[want]]).sum(1) - (target @ w.canon.T).amax(1)) * 20
            trust = torch.where(named > 0, 0.05 + 0.5 * knew.sigmoid(), torch.ones_like(knew))
        hold = (trust * (1 - (f * target).sum(1))).mean()
        return ce + bce + HOLD * hold, torch.stack([ce, bce, hold]).detach()


class Run:
    """The clock, the log, the files and the judge of a run."""

    def __init__(self, args):
        self.begin, self.args = time.time(), args
        os.makedirs(args.out, exist_ok=True)
        self.log = open(os.path.join(args.out, "smoke.jsonl" if args.smoke else "pooled.jsonl"), "w")

    def seconds(self):
        return time.time() - self.begin

    def tell(self, *what):
        print(f"[{self.seconds():.0f}s]", *what, flush=True)

    def note(self, **row):
        self.log.write(json.dumps({"seconds": round(self.seconds(), 1), **row}) + "\n")
        self.log.flush()

    def judged(self, judge, title, tower):
        """Figures of a tower; what the best one is chosen by: withheld names right and found at 3 %, choosing scenes right."""
        figures = judge.all(tower)
        table(f"[{self.seconds():.0f}s] {title}", figures)
        self.note(judge=title, figures=figures, columns=NAMES)
        both = figures[f"both {judge.sides[0]}"]
        return sum(both[k][i] for k, i in (("open", 0), ("open", 4), ("scenes", 0)) if k in both)

    def write(self, student, name):
        saved(student.steps.mean, os.path.join(self.args.out, name))


def load(args, run, device):
    """A student that computes what the bundle's tower does, with its pictures and its teacher's answers, and the judge."""
    few = (24 if KIND == "cuda" else 1) if args.smoke else 0
    words = Words(args.pack, device)
    withheld = words.withheld.cpu().numpy()
    extra = outlined(args.pack, device, few)
    run.tell("outlined", len(extra), "photographs without labels, masks", sum(int(m.max()) for m in extra.values()))
    photos = Photos(args.pack, withheld, device, few, extra, args.without)
    run.tell("photos", len(photos.pics), "things", len(photos.things), "with names", int((photos.things[:, 2] >= 0).sum()))
    tiles = class_labelled(args.pack, withheld, device, 64 if args.smoke else 0)
    canvases = Canvases(photos, tiles, Augment(device, args.seed + 1), device)
    run.tell("class-labelled", len(tiles[0]), "cut-outs", len(canvases.paste))
    first, chunk = tower_of(args.pack, device), 96 if KIND == "cuda" else 8
    said_things, said_tiles = teach_things(first, photos, chunk), teach_tiles(first, *tiles[:2], chunk)
    cls = torch.cat([photos.things[:, 2], tiles[2]])
    seen = Seen(words, torch.unique(cls[cls >= 0]))
    run.tell("the teacher has spoken; words of classes in training", int((seen.weight == 1).sum()))
    judge = Judge(args.pack, device, limit=(60 if KIND == "cuda" else 6) if args.smoke else 0)
    run.tell("judge", {k: len(v) for k, v in judge.kinds.items()})
    return Student(tower_of(args.pack, device), canvases, words, seen, said_things, said_tiles), judge, first


def train(args, run, student, judge, mixed, best):
    """Steps until --seconds are nearly over; weights each minute, figures every JUDGED_EVERY seconds."""
    size = (AREA, CUTS, WHOLES) if KIND == "cuda" else (4 * 448 * 448, 8, 4)
    stop = run.begin + args.seconds - (2 if args.smoke else END)
    begin, kept, judged, half = time.time(), time.time(), time.time(), False
    while time.time() < stop and not (args.smoke and student.steps.step >= 4):
        t = (time.time() - begin) / (stop - begin)
        student.step(t, *size)
        step = student.steps.step
        if step in (1, 2, 10) or step % (100 if KIND == "cuda" else 2) == 0:
            v = student.mean_losses()
            run.tell(f"step {step} photo (ce, bce, hold) {v[:3]} cut {v[3:6]} both {v[6:]} scale {float(student.scale[0].detach().exp()):.1f}")
            run.note(step=step, losses=v)
        if time.time() - kept > SAVED_EVERY:
            kept = time.time()
            run.write(student, "last.pt")
        if t > 0.5 and not half:
            half = True
            run.write(student, "half.pt")
        if time.time() - judged > JUDGED_EVERY and not args.smoke and time.time() < stop - 60:
            run.judged(judge, f"step {step} share 0.5", mixed(0.5))
            got = run.judged(judge, f"step {step} share 1", mixed(1.0))
            if got > best:
                best = got
                run.write(student, "best.pt")
            judged = time.time()


def arguments():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True, help="of wall-clock in all, preparation and last judgement included")
    ap.add_argument("--smoke", action="store_true", help="a few steps on a tiny subset, to see that all works")
    ap.add_argument("--seed", type=int, default=39)
    ap.add_argument("--without", nargs="*", default=[], metavar="SET", help="sets that are judged, not learnt from")
    return ap.parse_args()


def main():
    args, device = arguments(), torch.device(KIND)
    torch.manual_seed(args.seed)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    run = Run(args)
    student, judge, first = load(args, run, device)
    start = {k: v.clone() for k, v in first.state_dict().items()}

    def mixed(share):
        """The tower `share` of the way from the start to the mean weights."""
        t = tower_of(args.pack, device)
        t.load_state_dict({k: start[k] + share * (student.steps.mean[k] - start[k]) for k in start})
        return t

    train(args, run, student, judge, mixed, run.judged(judge, "start", first))
    run.write(student, "smoke.pt" if args.smoke else "last.pt")
    for share in (1.0,) if args.smoke else (1.0, 0.5, 0.75, 0.35):
        if share == 1.0 or run.seconds() < args.seconds - 10:
            run.judged(judge, f"end, step {student.steps.step} share {share}", mixed(share))
    run.tell("trained", student.steps.step)


if __name__ == "__main__":
    main()
