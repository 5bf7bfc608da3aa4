"""Trains the image tower on cuts, so that names without outlines are kept, and measures just that.

    python train_open.py --pack PACK --net net.npz --image ../../embedded/image_tower.onnx --out OUT --seconds S \
        --prepared FOLDER [--withhold]
    python train_open.py --prepare ...           # makes the files of --prepared and ends

It starts from the bundle's own image tower; batch norm is put back, so that it can be trained, and keeps its statistics, and
early layers move less, so that a mean of weights stays a good network. What never changes (outlines, teachers'
answers) is computed once, with --prepare, and read afterwards: GPU time is for training. With --withhold the names of
`withheld.txt` (and all that is a kind of one) are kept out of every bank of pictures; share and canon are chosen on those
*open names*, and the twin run without --withhold ships.

- Teachers look at each thing once, at its best: the tower that training begins with at the exact cut and at plain
  boxes (their mean names better than either), EfficientNet-Lite2 at the boxes. The tower learns to say the same of
  ragged, merged, hidden and small cuts, named or not (windows of photographs without labels, too).
- Half of the drawn things are cut by the mask network's own masks (net_masks.py): that is what the product cuts.
- A word that no picture of the sets shows is never taught as false with full weight: that is how unknown names sink.
- The frequencies of names are taken out of the choice of a name (logit adjustment).
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
from cut_banks import KIND, Cuts, Prepared, drawn_bank, stacked
from heldout import withheld_words
from losses import Steps, Words, imagined, imagined_loss, mean_of, opinion_loss, saved, which_name, which_words
from pictures import decode, exact, letterbox
from salient import Salient
from towers import fold, folded, lite2_of, normalised, unfold
from words_model import SIDE, ImageTower

SAVE_EVERY = 60  # seconds: a run that is cut off has weights of the last minute
ABSENT = 0.015  # "found" is also measured at the canon where this share of false words is found
# Learning rate; weight of the teachers' embedding, of EfficientNet-Lite2's opinion, of false words that no set shows.
LR, HOLD, OPINION, UNSEEN = 1.6e-4, 10.0, 0.6, 0.1
IMAGINED = 256  # features of EfficientNet-Lite2's classes, a step
SHARES = (0.2, 0.35, 0.5, 0.65, 0.8, 1.0)  # of the way to the trained tower that are measured at the end


class Measure:
    """Sets that training never sees, and what a tower says of them: found, absent, found at 1.5 %, right, first of all names."""

    def __init__(self, cuts, words, open_class, args, device):
        self.words, self.device = words, device
        held, _, _ = drawn_bank(os.path.join(args.pack, "drawn_held.npz"), args.net, device, args.limit)
        held = held.only(held.cls >= 0)
        opened = open_class.cpu()
        is_open = lambda b: (b.cls >= 0) & opened[b.cls.clamp(min=0)]  # still on the CPU, as all classes are
        opens = [b.only(is_open(b)) for b in (cuts.banks[0], held)]
        joined = lambda two: [torch.cat(v) for v in zip(*two)]
        photos = cuts.banks[1]
        some = few_of_each(photos, torch.nonzero(is_open(photos) & photos.outlined.cpu())[:, 0], 30)
        zh = np.load(os.path.join(args.pack, "held.npz"))
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
        self.sets = {k: ((exact(x, dim, margin) * 255).byte().to(device), c.to(device)) for k, (x, c, dim, margin) in sets.items() if len(c)}

    @torch.no_grad()
    def __call__(self, model):
        before, torch.backends.cudnn.benchmark = torch.backends.cudnn.benchmark, False
        out = {}
        for name, (x, c) in self.sets.items():
            with torch.autocast(KIND, dtype=torch.bfloat16):
                f = torch.cat([model(normalised(p.float() / 255)) for p in x.split(256)]).float()
            out[name] = self.figures(f, c)
        torch.backends.cudnn.benchmark = before
        return out

    def figures(self, f, c):
        w = self.words
        floor, mine = (f @ w.canon.T).amax(1), (f * w.text[w.own[c]]).sum(1)
        t, s = w.truth[c][:, w.everyday], f @ w.text[w.everyday].T
        false = (s - floor[:, None])[t == 0]
        shift = false.kthvalue(max(1, int(len(false) * (1 - ABSENT)))).values
        right = (t.gather(1, s.argmax(1)[:, None])[:, 0] != 0) | (mine >= s.amax(1))
        among = (f @ w.text[w.own_words].T).argmax(1) == w.own_of[c]
        r = lambda v: round(float(v.float().mean()), 4)
        return {"found": r(mine >= floor), "absent": r(false >= 0), "found at 1.5 %": r(mine >= floor + shift), "shift": r(shift), "right": r(right), "top1": r(among)}


def few_of_each(bank, rows, most):
    """At most `most` of `rows` of each class, chosen at random."""
    rows, seen, out = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(5))], {}, []
    for r in rows.tolist():
        c = int(bank.cls[r])
        seen[c] = seen.get(c, 0) + 1
        if seen[c] <= most:
            out.append(r)
    return out


class Seen:
    """How often each name is drawn, and which words are true of a class that is."""

    def __init__(self, cuts, words, sizes):
        device = words.own.device
        mass = torch.zeros(len(words.own), device=device)
        for b, n in zip(cuts.banks, sizes):
            named = b.cls >= 0
            share = b.weight / b.weight.sum() * n / sum(sizes)
            mass.index_add_(0, b.cls[named], share[named])
        self.classes = mass > 1e-6
        prior = torch.zeros(len(words.own_words), device=device).index_add_(0, words.own_of, mass)
        self.log_prior = prior.clamp(min=1e-6).log() - prior.clamp(min=1e-6).log().mean()
        self.names = prior > 1e-6
        self.words = ((words.truth[: len(words.own)] == 1) & (mass[:, None] > 2e-4)).any(0)
        self.weight = torch.where(self.words, 1.0, UNSEEN)


class Student:
    """The tower that is trained, and what its losses are."""

    def __init__(self, tower, fc, words, seen, sizes):
        self.tower, self.fc, self.words, self.seen = tower, fc, words, seen
        device = words.own.device
        self.scale = nn.Parameter(torch.tensor([math.log(36.0), math.log(36.0)], device=device))
        order = torch.arange(sum(sizes), device=device)
        self.is_cut = (order < sizes[0]) | ((order >= sum(sizes[:2])) & (order < sum(sizes[:3])))
        early, late = [], []
        for n, p in tower.body.named_parameters():
            deep = n.startswith(("_conv_head", "_bn1")) or n.startswith("_blocks.") and int(n.split(".")[1]) >= 13
            (late if deep else early).append(p)
        groups = [{"params": early, "k": 0.25, "weight_decay": 0.01}, {"params": late, "k": 0.6, "weight_decay": 0.01},
                  {"params": [*tower.out.parameters(), self.scale], "k": 1.2, "weight_decay": 0.0}]
        self.steps = Steps(tower, groups, LR, 120, 0.998)
        self.sums, self.n = torch.zeros(6, device=device), 0

    def train(self):
        self.tower.train()
        for m in self.tower.modules():
            if isinstance(m, nn.BatchNorm2d):
                m.eval()

    def step(self, batch, t):
        self.train()
        parts = self.losses(*batch)
        self.steps.take(parts[0], t)
        self.sums += torch.stack([p.detach() for p in parts])
        self.n += 1

    def mean_losses(self):
        """Of the steps since the last call: all, names, words, teacher, EfficientNet-Lite2's opinion, imagined features."""
        v = [round(x, 4) for x in (self.sums / self.n).tolist()]
        self.sums.zero_()
        self.n = 0
        return v

    def losses(self, x, clean, mask, cls, target, opinion, trust):
        w = self.words
        with torch.autocast(KIND, dtype=torch.bfloat16):
            features = self.tower.body.head(normalised(x))
            f = self.tower.embed(features)
            made, k = imagined(self.tower.embed, features, self.fc, IMAGINED)
            logits = self.fc(features).float()
        sc = self.scale.exp()
        named, c = (cls >= 0).float(), cls.clamp(min=0)
        cos, want, truth = f @ w.text.T, w.own_of[c], w.truth[c].clone()
        ce = mean_of(which_name(cos, want, truth, w.own_words, sc[0], self.seen.log_prior, self.seen.names), named)
        margin = (cos - (f @ w.canon.T).amax(1, keepdim=True)) * sc[1].clamp(max=40)
        truth[:, w.colours] = torch.where(self.is_cut[:, None], dominant_colour(clean, mask), -1).to(truth.dtype)
        bce = mean_of(which_words(margin, truth, w.own_words[want], self.seen.weight), named)
        # The teachers: less where they did not know a name that is known.
        with torch.no_grad():
            p, sure = (opinion / 1.5).softmax(-1), opinion.softmax(-1).amax(1)
            knew = ((target * w.text[w.own_words[want]]).sum(1) - (target @ w.canon.T).amax(1)) * 20
            w_hold = torch.where(named > 0, 0.05 + 0.5 * knew.sigmoid(), torch.ones_like(knew)) * trust
            agrees = (p * (w.truth[c][:, w.thousand] != 0)).sum(1)
            w_kd = torch.where(named > 0, agrees, sure) * trust
        hold = (w_hold * (1 - (f * target).sum(1))).sum() / len(cls)
        kd = (w_kd * (opinion_loss(sc[0] * cos[:, w.thousand], opinion) + 0.5 * opinion_loss(logits / 1.5, opinion))).mean()
        unreal = imagined_loss(made, k, w.text[w.thousand], w.canon, sc)
        return [ce + bce + HOLD * hold + OPINION * kd + 0.2 * unreal, ce, bce, hold, kd, unreal]


class Run:
    """The clock, the log and the files of a run."""

    def __init__(self, out, name):
        self.name, self.start = name, time.time()
        os.makedirs(out, exist_ok=True)
        self.at = lambda n: os.path.join(out, (name + "_" if name else "") + n)
        self.log = open(self.at("open.jsonl"), "w")

    def note(self, **row):
        self.log.write(json.dumps(row) + "\n")
        self.log.flush()

    def tell(self, *what):
        print(f"[{self.name} {time.time() - self.start:.0f}s]", *what, flush=True)

    def figures(self, tag, figures):
        self.tell(tag, json.dumps({k: list(v.values()) for k, v in figures.items()}))
        self.note(tag=tag, figures=figures)


def flat(state, device):
    """The tower of folded weights."""
    tower = fold(ImageTower()).to(device).eval().requires_grad_(False).to(memory_format=torch.channels_last)
    tower.load_state_dict(state)
    return tower


def blended(shipped, mean, share, device):
    """The tower `share` of the way from the shipped one to the weights `mean`."""
    with torch.no_grad():
        tower = ImageTower().to(device)
        tower.load_state_dict(mean)
        now = fold(tower.eval()).state_dict()
        return flat({k: shipped[k].to(device) + share * (v - shipped[k].to(device)) for k, v in now.items()}, device)


def load(args, run, device):
    """Words, which classes are open, the banks with what the teachers say, EfficientNet-Lite2 and the shipped weights."""
    words = Words(args.pack, device)
    index = {w: i for i, w in enumerate(words.words)}
    listed = torch.tensor(sorted(index[w] for w in withheld_words() if w in index), device=device)
    run.tell("withheld words without an entry:", [w for w in withheld_words() if w not in index])
    open_class = (words.truth[: len(words.own)][:, listed] == 1).any(1) | torch.isin(words.own, listed)
    prepared = Prepared(args.prepared, args.prepare)
    salient = lambda: Salient(args.salient, device, torch.float16 if KIND == "cuda" else torch.float32)
    cuts = Cuts(args.pack, salient, args.net, prepared, device, args.seed + 1, args.limit)
    run.tell("outlines:", {b.name: (len(b.cls), int(b.outlined.sum())) for b in cuts.banks})
    lite2 = lite2_of(os.path.join(args.pack, "lite2.npz")).to(device).eval().requires_grad_(False).to(memory_format=torch.channels_last)
    shipped = folded(args.image)
    cuts.ask(prepared, flat(shipped, device), lite2)
    run.tell("asked the teachers")
    return words, open_class, cuts, lite2, shipped


def student_of(args, words, cuts, lite2, shipped, seen, device):
    """A student that computes what the shipped tower does."""
    with torch.no_grad():
        sample = normalised(cuts.batch([k * (3 if KIND == "cuda" else 1) for k in args.batch])[0])
    tower = ImageTower().to(device)
    unfold(tower, shipped, sample)
    tower.requires_grad_(True)
    return Student(tower.to(memory_format=torch.channels_last), lite2._fc, words, seen, args.batch)


def train(args, run, cuts, student, measured):
    """Steps for --seconds; weights each minute, figures at --marks."""
    begin, kept, marks = time.time(), time.time(), list(args.marks)
    torch.backends.cudnn.benchmark = True
    while (t := (time.time() - begin) / args.seconds) < 1:
        student.step(cuts.batch(args.batch), t)
        step = student.steps.step
        if step == 1:
            # The library has chosen its algorithms: what came before is no training.
            run.tell(f"first step done, {time.time() - begin:.0f} s after the beginning")
        if time.time() - kept > SAVE_EVERY:
            kept = time.time()
            write(run, student, "open.pt")
        if step % (50 if KIND == "cuda" else 1) == 0:
            v = student.mean_losses()
            run.tell(f"step {step}: loss, ce, bce, hold, kd, made {v} scale {float(student.scale[0].detach().exp()):.1f}")
            run.note(step=step, seconds=round(time.time() - begin, 1), losses=v)
        if marks and t > marks[0]:
            measured(f"at {marks.pop(0):.2f}", (0.4, 1.0))
    return student.steps.step


def write(run, student, name):
    saved({"tower." + k: v for k, v in student.steps.mean.items()}, run.at(name))


def arguments():
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
    ap.add_argument("--marks", type=float, nargs="*", default=[0.15, 0.3, 0.45, 0.6, 0.75, 0.9], help="shares of the time at which the tower is measured")
    return ap.parse_args()


def main():
    args, device = arguments(), torch.device(KIND)
    torch.manual_seed(args.seed)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    run = Run(args.out, args.name)
    words, open_class, cuts, lite2, shipped = load(args, run, device)
    if args.prepare:
        return
    measure = Measure(cuts, words, open_class, args, device)
    run.tell("sets:", {k: len(c) for k, (_, c) in measure.sets.items()}, "withheld classes", int(open_class.sum()))
    run.figures("shipped", measure(flat(shipped, device)))
    cuts.ready(open_class if args.withhold else torch.zeros_like(open_class))
    seen = Seen(cuts, words, args.batch)
    run.tell("classes seen", int(seen.classes.sum()), "words seen", int(seen.words.sum()), "of", len(words.text))
    student = student_of(args, words, cuts, lite2, shipped, seen, device)

    def measured(tag, shares):
        for share in shares:
            run.figures(f"{tag} share {share}", measure(blended(shipped, student.steps.mean, share, device)))

    run.tell("ready")
    steps = train(args, run, cuts, student, measured)
    write(run, student, "open.pt")
    measured("end", SHARES)
    run.tell("trained", steps)


if __name__ == "__main__":
    main()
