"""Trains the geometry network on rendered rooms and on real photos; an EMA in fp16 comes out.

    python train.py --pack PACK --data DATA --scenes SCENES --out OUT --seconds S --init start.pt
    torchrun --standalone --nproc-per-node N train.py ...      the same on N GPUs

PACK is of prepare.py, DATA of captures.py and pairs.py, SCENES the shared scenes that judge. Without
DATA it is the recipe from nothing: rendered rooms alone, depth alone at first.

Loss of rendered rooms: inverse depth relative to the searched range at three scales, cross entropy
of the sweep, and unseen views drawn by gsplat (classic mode, as the product draws). Loss of real
photos: the unseen views alone. Inputs and views have pixels of their own; a share of the inputs is
of small photos, as the product brings them to the network's size.
Everything is seeded; the schedule follows the share of time used.
"""
import argparse
import glob
import io
import json
import math
import os
import random
import time

import torch
import torch.distributed as dist
import torch.nn.functional as F

from judge import VIEWS as VIEWS_JUDGED
from judge import Judge
from model import GeometryNet
from splats import depth_loss, nearest_views, picture_loss, render, with_inputs

HERE = os.path.dirname(os.path.abspath(__file__))
ASPECTS = [1] * 7 + [4 / 3, 3 / 4, 5 / 3, 3 / 5]  # width over height
SMALL = 256  # root of the pixels of a small photo
VIEWS = ["2:0.5", "3:0.08", "4:0.18", "6:0.09", "8:0.15"]
PART = 15 << 20  # bytes of one file of weights


def parse():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True, help="wall clock of all, loading and judging included")
    ap.add_argument("--init", help="weights to start from")
    ap.add_argument("--data", help="real photos to train on")
    ap.add_argument("--only", nargs="*", help="captures to train on")
    ap.add_argument("--scenes", help="shared scenes, for the log")
    ap.add_argument("--judge-every", type=int, default=3, help="every n-th triple is judged")
    ap.add_argument("--judges", type=int, default=3, help="judgements after the first, the last one included")
    ap.add_argument("--lr", type=float, default=5e-4)
    ap.add_argument("--real-share", type=float, default=0.6)
    ap.add_argument("--depth-share", type=float, default=0.08, help="share of the time on depth alone, without --init")
    ap.add_argument("--save-every", type=float, default=150)
    ap.add_argument("--steps", type=int, default=10**9)
    ap.add_argument("--seed", type=int, default=1)
    ap.add_argument("--views", nargs="*", default=VIEWS, help="photos of a set and how often it is drawn, N:SHARE")
    ap.add_argument("--robust", type=float, help="an error of a real photo far over this counts no more")
    ap.add_argument("--log-weight", type=float, default=0.02, help="of the logarithm of the error in the loss")
    ap.add_argument("--target-sides", nargs="*", default=["256:0.7", "512:0.3"], help="the same of a view")
    ap.add_argument("--small-share", type=float, default=0.0, help="share of the steps whose photos are small")
    ap.add_argument("--judge-side", type=int, default=SMALL, help="side of the inputs that are judged; the photos are small")
    ap.add_argument("--judge-views", type=int, nargs="*", default=VIEWS_JUDGED, help="photos of the sets that are judged")
    ap.add_argument("--warm-up", type=int, default=200, help="steps")
    ap.add_argument("--batch", type=int, default=16, help="pairs a step of 256 x 256; fewer sets of more views and of more pixels")
    ap.add_argument("--sides", nargs="*", default=["256:1"], help="roots of the pixels of an input and how often each is drawn, SIDE:SHARE")
    ap.add_argument("--eight-bits", nargs="+", metavar="FILE", help="GRAPH RANGES [FIRST]: round as the CPU file does (eight_bits.py)")
    ap.add_argument("--float-share", type=float, default=0.2, help="share of the steps without these roundings")
    return ap.parse_args()


class Ranks:
    """One process, or one for each GPU."""

    def __init__(self):
        self.many = "RANK" in os.environ
        if self.many:
            dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        self.rank, self.count = (dist.get_rank(), dist.get_world_size()) if self.many else (0, 1)
        self.device = torch.device("cuda", self.rank) if torch.cuda.is_available() else torch.device("cpu")
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)

    def clock(self, start):
        """Seconds since the start, the same on all."""
        t = torch.tensor([time.time() - start], device=self.device)
        if self.many:
            dist.broadcast(t, 0)
        return t.item()

    def mean_gradients(self, params):
        if self.many:
            flat = torch.cat([p.grad.flatten() for p in params])
            dist.all_reduce(flat)
            flat /= self.count
            at = 0
            for p in params:
                p.grad.copy_(flat[at : at + p.numel()].view_as(p))
                at += p.numel()


class Data:
    """Rendered rooms, and real photos where there are any."""

    def __init__(self, args, ranks):
        from scenes import World

        seed = 1000 * args.seed + ranks.rank
        self.world = World(extension(), args.pack, ranks.device, seed)
        self.photos = None
        if args.data:
            from photos import Captures

            self.photos = Captures(args.data, ranks.device, seed, args.only)

    def batch(self, real, B, V, T, size, target_size, wide):
        """(images, targets, mask or None, depth or None, K, c2w, near, far)."""
        if real:
            images, targets, mask, K, c2w, near, far = self.photos.batch(B, V, T, size, target_size)
            return images, targets, mask, None, K, c2w, near, far
        images, targets, depth, K, c2w, near, far = self.world.batch(B, V, T, size, target_size, wide)
        return images, targets, None, depth, K, c2w, near, far


def drawn(draw, choices):
    """One of the numbers NUMBER:SHARE."""
    numbers, shares = zip(*(each.split(":") for each in choices))
    return int(draw.choices(numbers, [float(share) for share in shares])[0])


def shape(side, aspect):
    """(height, width), multiples of 32, of about side^2 pixels."""
    return tuple(32 * round(length / 32) for length in (side / math.sqrt(aspect), side * math.sqrt(aspect)))


def resized(x, size, mode):
    """[B,V,...,h,w] at another size."""
    many = x.flatten(0, 1) if x.ndim == 5 else x
    how = {} if mode == "nearest" else {"align_corners": False}
    return F.interpolate(many, size, mode=mode, **how).reshape(*x.shape[:-2], *size)


def extension():
    from torch.utils.cpp_extension import load

    return load("raycast", [os.path.join(HERE, "raycast.cu")], extra_cflags=["-O3"], extra_cuda_cflags=["-O3", "--use_fast_math"])


def write_parts(folder, what, state, step):
    """In parts of at most 15 MiB; the parts of an earlier step go when all are there."""
    blob = io.BytesIO()
    torch.save(state, blob)
    blob = blob.getvalue()
    old = glob.glob(os.path.join(folder, f"{what}-*"))
    count = -(-len(blob) // PART)
    names = [os.path.join(folder, f"{what}-{step:06d}-{i}of{count}.bin") for i in range(count)]
    for i, name in enumerate(names):
        with open(name + ".tmp", "wb") as file:
            file.write(blob[i * PART : (i + 1) * PART])
        os.replace(name + ".tmp", name)
    for name in set(old) - set(names):
        os.remove(name)


class Trainer:
    def __init__(self, args, ranks, start):
        self.args, self.ranks, self.start = args, ranks, start
        os.makedirs(args.out, exist_ok=True)
        self.log = open(os.path.join(args.out, "log.jsonl"), "a") if ranks.rank == 0 else None
        torch.manual_seed(args.seed)
        self.net = GeometryNet().to(ranks.device)
        if args.init:
            self.net.load_state_dict({k: v.float() for k, v in torch.load(args.init).items()})
        self.ema = {k: v.clone() for k, v in self.net.state_dict().items()}
        self.rounding = None
        if args.eight_bits:
            from eight_bits import EightBits

            self.rounding = EightBits(self.net, *args.eight_bits)
        self.params = list(self.net.parameters())
        matrices, rest = [p for p in self.params if p.ndim > 1], [p for p in self.params if p.ndim <= 1]
        groups = [{"params": matrices, "weight_decay": 0.02}, {"params": rest, "weight_decay": 0.0}]
        self.opt = torch.optim.AdamW(groups, lr=args.lr, betas=(0.9, 0.98), fused=ranks.device.type == "cuda")
        self.data = Data(args, ranks)
        self.step, self.skipped, self.sums, self.judge_of = 0, 0, {}, None
        self.say(loaded=round(time.time() - start, 1), captures=self.data.photos.about() if self.data.photos else None)
        if args.scenes and ranks.rank == 0:
            held_out = [os.path.dirname(p) for p in sorted(glob.glob(os.path.join(args.data or "", "*", "cameras.json"))) if '"held_out": true' in open(p).read(400)]
            self.judge_of = Judge(args.scenes, held_out, ranks.device, args.judge_views, args.judge_side)
            self.say(judge_loaded=round(time.time() - start, 1), triples=len(self.judge_of.items))

    def say(self, **kw):
        if self.log:
            line = json.dumps(kw)
            self.log.write(line + "\n")
            self.log.flush()
            print(line, flush=True)

    # -- judging and writing
    def judge(self, tag, every):
        if not self.judge_of:
            return
        begun = time.time()
        keep = {k: v.clone() for k, v in self.net.state_dict().items()}
        self.net.load_state_dict(self.ema)
        self.net.eval()
        if self.rounding:
            self.rounding.on = True
        by_use, by_scene = self.judge_of.figures(self.net, every)
        if tag in ("start", "final"):
            self.judge_of.sheet(self.net, os.path.join(self.args.out, f"{tag}.jpg"))
        self.net.load_state_dict(keep)
        self.net.train()
        self.say(judge=tag, every=every, step=self.step, t=round(time.time() - self.start), took=round(time.time() - begun, 1), uses=by_use, scenes=by_scene)

    def write(self, what, state):
        if not self.ranks.rank:
            write_parts(self.args.out, what, state, self.step)

    def save(self):
        self.write("weights", {k: v.half() for k, v in self.ema.items()})

    def save_optimiser(self):
        """Both moments as halves (the second as its root), by the order of the parameters."""
        state = [self.opt.state.get(p) for group in self.opt.param_groups for p in group["params"]]
        self.write("optimiser", [s and (s["exp_avg"].half(), s["exp_avg_sq"].sqrt().half()) for s in state])

    # -- training
    def train(self, seconds):
        """Trains until `seconds` after the start; judges and saves on the way."""
        begun = self.ranks.clock(self.start)
        next_judge, next_save, now = 1, begun + self.args.save_every, begun
        while self.step < self.args.steps:
            if self.step % 10 == 0:
                now = self.ranks.clock(self.start)
            share = (now - begun) / max(seconds - begun, 1e-9)
            if share >= 1:
                break
            if next_judge < self.args.judges and share > next_judge / self.args.judges:
                self.judge(f"{next_judge} of {self.args.judges}", 2 * self.args.judge_every)
                next_judge += 1
            if now > next_save:
                self.save()
                next_save = now + self.args.save_every
            self.one_step(share)
            if self.step % 50 == 0:
                self.report(share)

    def one_step(self, share):
        args, device = self.args, self.ranks.device
        draw = random.Random(args.seed * 1000003 + self.step)
        real = self.data.photos is not None and draw.random() < args.real_share
        depth_only = share < args.depth_share and not args.init
        wide = 1.0 if args.init else min(max((share - 0.08) / 0.4, 0.0), 1.0)
        V, side = drawn(draw, args.views), drawn(draw, args.sides)
        target_side, aspect = drawn(draw, args.target_sides), draw.choice(ASPECTS)
        size, target_size = shape(side, aspect), shape(target_side, aspect)
        small = draw.random() < args.small_share and side > SMALL
        B, T = max(round(args.batch * 2 / V * (SMALL / side) ** 2), 1), 2 if target_side < 1.3 * side else 1
        with torch.no_grad():
            images, targets, mask, depth, K, c2w, near, far = self.data.batch(real, B, V, T, shape(SMALL, aspect) if small else size, target_size, wide)
            if small:
                images, depth = resized(images, size, "bilinear"), depth if depth is None else resized(depth, size, "nearest")
        lr = args.lr * min(1.0, (self.step + 1) / args.warm_up) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(share, 1))))
        for group in self.opt.param_groups:
            group["lr"] = lr
        if self.rounding:
            self.rounding.on = draw.random() >= args.float_share
        with torch.autocast(device.type, dtype=torch.bfloat16):
            out = self.net(images, K[:, :V], c2w[:, :V], near, far, nearest_views(c2w[:, :V], min(V - 1, 3)))
        loss, mse, err = 0.0, None, None
        if depth is not None:
            dl, ce, err = depth_loss(out, depth, near, far)
            loss = dl + 0.05 * ce
        if not depth_only:
            pic = render(with_inputs(out, images, K[:, :V], c2w[:, :V]), c2w[:, V:], K[:, V:], *target_size).flatten(0, 1)
            want = targets.flatten(0, 1)
            if mask is not None:  # where no input looks there is nothing to learn
                want = torch.where(mask.flatten(0, 1) > 0, want, pic.detach())
            picture, mse = picture_loss(pic, want, args.robust if real else None, args.log_weight)
            loss = 0.25 * loss + picture
        self.update(loss)
        kind = ("real" if real else "made") + ("q" if self.rounding and self.rounding.on else "")
        if mse is not None:
            self.add(f"{kind}{V}@{side}" + ("small" if small else ""), -10 * math.log10(max(mse.item(), 1e-9)))
        if err is not None:
            self.add("depth", err.item())

    def update(self, loss):
        self.opt.zero_grad(set_to_none=False)
        loss.backward()
        for p in self.params:
            if p.grad is None:
                p.grad = torch.zeros_like(p)
        self.ranks.mean_gradients(self.params)
        norm = torch.nn.utils.clip_grad_norm_(self.params, 1.0)
        if torch.isfinite(norm):
            self.opt.step()
        else:
            self.skipped += 1
        self.step += 1
        d = min(0.999, (self.step + 1) / (self.step + 20))
        with torch.no_grad():
            now = self.net.state_dict()
            torch._foreach_lerp_([self.ema[k] for k in now], list(now.values()), 1 - d)
        self.add("norm", norm.item())

    def add(self, key, value):
        a = self.sums.setdefault(key, [0.0, 0])
        a[0] += value
        a[1] += 1

    def report(self, share):
        lr = self.opt.param_groups[0]["lr"]
        memory = torch.cuda.max_memory_allocated() >> 20 if self.ranks.device.type == "cuda" else 0
        means = {k: round(v[0] / v[1], 4) for k, v in sorted(self.sums.items())}
        self.say(step=self.step, t=round(time.time() - self.start, 1), share=round(share, 3), lr=round(lr, 6), skipped=self.skipped, mem=memory, **means)
        self.sums = {}


def main():
    start = time.time()
    args = parse()
    # Products of matrices that are not in bf16 are those of cameras: TF32 moves a point by a tenth of a pixel.
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = True
    # Without a search for the fastest convolutions: a step takes as long, the first of each shape 4 s, not 15.
    torch.backends.cudnn.benchmark = False
    trainer = Trainer(args, Ranks(), start)
    begun = time.time()
    trainer.judge("start", args.judge_every)
    last = time.time() - begun + 15  # the last judgement takes as long as the first
    trainer.train(args.seconds - last)
    trainer.save()
    trainer.judge("final", args.judge_every)
    trainer.save_optimiser()
    trainer.say(done=True, step=trainer.step, skipped=trainer.skipped, t=round(time.time() - start, 1))
    if trainer.ranks.many:
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
