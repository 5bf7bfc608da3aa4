"""Trains the mask network on rendered scenes (exact instances) and photographs with drawn regions.

    torchrun --standalone --nproc-per-node N train_masks.py --pack PACK --out OUT --seconds S \
        [--init weights.pt] [--look FOLDER_OF_PHOTOS] [--rooms 8] [--photos 16]

PACK: geometry/prepare.py's meshes and textures, lite2.pt, and the .tar files of views.SETS.

A prompt is a pixel of a thing, chosen so that small things are asked for as well. Level 2 learns the
whole thing, level 0 the part under the pixel, level 1 whichever is nearer. Loss: BCE + dice, and the
squared error of the predicted IoU. The schedule follows the share of time used; seeded.
"""
import argparse
import json
import math
import os
import random
import time

import numpy as np
import torch
import torch.distributed as dist
import torch.nn.functional as F
from PIL import Image

from masks_model import LEVELS, MaskNet
from views import KIND, SETS, Photographs, Rooms, extension, join

SIDE, PROMPTS = 512, 24


def normalised(rgb):
    return (rgb * 255 - 127) / 128


@torch.no_grad()
def prompts(whole, part, P, gen, exponent=0.6):
    """Points [B,P,2,2] (x, y), labels [B,P,2] and soft masks whole, part [B,P,128,128]."""
    B, dev = len(whole), whole.device
    rand = lambda high: torch.randint(0, high, (B, P), device=dev, generator=gen)
    pick = torch.arange(B, device=dev)[:, None]
    small = whole[:, 2::4, 2::4].flatten(1).long()
    # Cells of each thing of each picture; -1 is a number, too.
    keys = small + 1 + pick * (small.amax() + 2)
    weight = torch.bincount(keys.flatten())[keys].float() ** -exponent * (small >= 0)
    weight = torch.where(weight.sum(1, keepdim=True) > 0, weight, 1.0)
    at = torch.multinomial(weight, P, True, generator=gen)
    y, x = at // 128 * 4 + rand(4), at % 128 * 4 + rand(4)
    w_id, p_id = whole[pick, y, x], part[pick, y, x]
    w = (whole[:, None] == w_id[..., None, None]) & (w_id >= 0)[..., None, None]
    p = (part[:, None] == p_id[..., None, None]) & w
    w4, p4 = F.avg_pool2d(w.float(), 4), F.avg_pool2d(p.float(), 4)
    kind = torch.rand(B, P, device=dev, generator=gen)
    pool = torch.where((kind < 0.2)[..., None], w4.flatten(2), 1 - w4.flatten(2)) + 1e-6
    more = torch.multinomial(pool.flatten(0, 1), 1, generator=gen).reshape(B, P)
    label = torch.where(kind < 0.2, 1, torch.where(kind < 0.3, 0, -1))
    coords = torch.stack([torch.stack([x, y], -1), torch.stack([more % 128, more // 128], -1) * 4 + 2], 2).float()
    labels = torch.stack([(w_id >= 0).int() * 2 - 1, label.int()], -1)
    # A second point on the thing but off the part asks for the thing.
    ask = (label == 1) & (p4.flatten(2).gather(2, more[..., None])[..., 0] < 0.5)
    return coords, labels, w4, torch.where(ask[..., None, None], w4, p4)


def distance(logits, target):
    """BCE (weighted to the rarer side a little) + dice of [M,h,w] logits to soft targets, each [M]."""
    bce = F.binary_cross_entropy_with_logits(logits, target, reduction="none").mean((1, 2))
    p = logits.sigmoid()
    dice = 1 - (2 * (p * target).sum((1, 2)) + 1) / (p.sum((1, 2)) + target.sum((1, 2)) + 1)
    return 4 * bce + dice


def iou_of(logits, target):
    a, b = logits > 0, target > 0.5
    return (a & b).sum((-1, -2)).float() / (a | b).sum((-1, -2)).clamp(min=1).float()


def loss_of(net, rgb, whole, part, gen):
    coords, labels, tw, tp = prompts(whole, part, PROMPTS, gen)
    with torch.autocast(KIND, dtype=torch.bfloat16):
        masks, iou = net(normalised(rgb).contiguous(memory_format=torch.channels_last), coords, labels)
    masks, iou = masks.float(), iou.float()
    m = masks.flatten(0, 1)
    tw, tp, iou = tw.flatten(0, 1), tp.flatten(0, 1), iou.flatten(0, 1)
    ok = (labels[..., 0].flatten() == 1) & (tw.sum((1, 2)) > 1.5)
    okp = ok & (tp.sum((1, 2)) > 1.5)
    differ = (tp.sum((1, 2)) < 0.9 * tw.sum((1, 2))) & okp
    l2 = distance(m[:, 2], tw)
    l0 = distance(m[:, 0], tp)
    l1 = torch.minimum(distance(m[:, 1], tw), distance(m[:, 1], tp))
    mean = lambda l, keep: (l * keep).sum() / keep.sum().clamp(min=1)
    loss = mean(l2, ok.float()) + mean(l0, okp * torch.where(differ, 0.5, 0.2)) * 0.5 + 0.3 * mean(l1, ok.float())
    with torch.no_grad():
        with_whole = iou_of(m, tw[:, None].expand(-1, LEVELS, -1, -1))
        best = torch.maximum(with_whole, iou_of(m, tp[:, None].expand(-1, LEVELS, -1, -1)) * okp[:, None])
        truth = torch.cat([best[:, :2], with_whole[:, 2:]], 1)
    loss = loss + mean(((iou - truth) ** 2).mean(1), ok.float()) * 3
    return loss, mean(with_whole[:, 2], ok.float())


@torch.no_grad()
def score(net, rgb, whole, part, seed):
    """Mean IoU of level 2, and of the best level, with the whole thing at points drawn as a grid would."""
    gen = torch.Generator(device=rgb.device).manual_seed(seed)
    coords, labels, tw, _ = prompts(whole, part, 32, gen, exponent=0.5)
    labels[..., 1] = -1
    with torch.autocast(KIND, dtype=torch.bfloat16):
        masks, iou = net(normalised(rgb), coords, labels)
    with_whole = iou_of(masks.float(), tw[:, :, None].expand(-1, -1, LEVELS, -1, -1))
    ok = (labels[..., 0] == 1).float()
    mean = lambda v: float((v * ok).sum() / ok.sum().clamp(min=1))
    return mean(with_whole[..., 2]), mean(with_whole.amax(-1)), mean((iou.float()[..., 2] - with_whole[..., 2]).abs())


@torch.no_grad()
def look(net, path, device, side=24):
    """A photo with its whole-thing masks, painted best last."""
    img = Image.open(path).convert("RGB")
    k = SIDE / max(img.size)
    img = img.resize((round(img.width * k), round(img.height * k)), Image.BILINEAR)
    a = torch.from_numpy(np.asarray(img).copy()).to(device).permute(2, 0, 1).float() / 255
    x = torch.zeros(1, 3, SIDE, SIDE, device=device)
    h, w = a.shape[1:]
    x[0, :, :h, :w] = normalised(a)
    gx = (torch.arange(side, device=device) + 0.5) / side * w
    gy = (torch.arange(side, device=device) + 0.5) / side * h
    pts = torch.stack([gx[None].expand(side, side), gy[:, None].expand(side, side)], -1).reshape(1, -1, 1, 2)
    with torch.autocast(KIND, dtype=torch.bfloat16):
        e = net.encoder(x)
        masks, iou = net.decoder.many(e, pts, torch.ones(pts.shape[:3], device=device))
    m, s = masks[0, :, 2].float(), iou[0, :, 2].float()
    order = s.argsort(descending=True)
    owner = torch.full(m.shape[1:], -1, device=device, dtype=torch.long)
    kept = []
    for i in order.tolist():
        if s[i] < 0.6:
            break
        mine = m[i] > 0
        if all(((mine & o).sum() / (mine | o).sum().clamp(min=1)) < 0.6 for o in kept):
            kept.append(mine)
            owner[(owner < 0) & mine] = len(kept) - 1
    g = torch.Generator().manual_seed(1)
    colours = torch.rand(len(kept) + 1, 3, generator=g).to(device)
    colours[-1] = 0
    paint = colours[owner].permute(2, 0, 1)[None]
    paint = F.interpolate(paint, (SIDE, SIDE), mode="nearest")[0, :, :h, :w]
    both = torch.cat([a, a * 0.35 + paint * 0.65], 2)
    return Image.fromarray((both.clamp(0, 1) * 255).byte().permute(1, 2, 0).cpu().numpy()), len(kept)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True)
    ap.add_argument("--init")
    ap.add_argument("--look")
    ap.add_argument("--lr", type=float, default=8e-4)
    ap.add_argument("--rooms", type=int, default=8, help="rendered pictures a step; 0 to try the script on a processor")
    ap.add_argument("--photos", type=int, default=8, help="photographs a step")
    args = ap.parse_args()
    rank, world, device = join()
    torch.manual_seed(100 + rank), random.seed(rank), np.random.seed(rank)
    torch.backends.cuda.matmul.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    start = time.time()
    rooms = Rooms(extension(), args.pack, device, 1000 + rank) if args.rooms else None
    photos = Photographs(args.pack, "train", device, 2000 + rank)
    held = Photographs(args.pack, "heldout", device, 3000)
    gen = torch.Generator(device=device).manual_seed(4000 + rank)
    net = MaskNet(SIDE)
    net.encoder.body.load(os.path.join(args.pack, "lite2.pt"))
    if args.init:
        net.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in torch.load(args.init, map_location="cpu").items()})
    net = net.to(device).to(memory_format=torch.channels_last)
    ema = MaskNet(SIDE).to(device)
    ema.load_state_dict(net.state_dict())
    pairs = [(a, b) for a, b in zip(ema.state_dict().values(), net.state_dict().values()) if a.is_floating_point()]
    kept, live = [p[0] for p in pairs], [p[1] for p in pairs]
    body = list(net.encoder.body.parameters())
    ids = {id(p) for p in body}
    rest = [p for p in net.parameters() if id(p) not in ids]
    opt = torch.optim.AdamW([{"params": body, "k": 0.3}, {"params": rest, "k": 1.0}], lr=args.lr, weight_decay=0.02, betas=(0.9, 0.98))
    model = torch.nn.parallel.DistributedDataParallel(net, device_ids=[device.index] if device.type == "cuda" else None, broadcast_buffers=False)
    os.makedirs(args.out, exist_ok=True)
    log = open(os.path.join(args.out, f"masks{rank}.jsonl"), "w")
    if rank == 0:
        print("ready", round(time.time() - start, 1), "photos", len(photos), "held", len(held), flush=True)
    begin, step, sums, n = time.time(), 0, torch.zeros(3, device=device), 0

    def evaluate(tag):
        ema.eval()
        rows = {}
        for source in SETS:
            pick = [i for i, k in enumerate(held.kind) if k[0] == source]
            got = [score(ema, held.rgb[i : i + 1].float() / 255, held.whole[i : i + 1].int(), held.fine[i : i + 1].int(), i) for i in pick]
            if got:
                rows[source] = [round(float(np.mean([g[c] for g in got])), 3) for c in range(3)]
        if rooms is None:
            print(tag, json.dumps(rows), flush=True)
            return
        fresh = Rooms.__new__(Rooms)
        fresh.__dict__ = dict(rooms.__dict__)
        fresh.gen = torch.Generator(device=device).manual_seed(77)
        got = []
        for _ in range(8):
            rgb, whole, part, _ = fresh.views(4, SIDE)
            got.append(score(ema, rgb, whole, part, 5))
        rows["rooms"] = [round(float(np.mean([g[c] for g in got])), 3) for c in range(3)]
        print(tag, "level 2, best level, |iou error|:", json.dumps(rows), flush=True)
        log.write(json.dumps({"step": step, "held": rows}) + "\n")
        log.flush()

    done = False
    next_eval = 0.5
    while not done:
        t = (time.time() - begin) / args.seconds
        stop = torch.tensor([float(t >= 1)], device=device)
        dist.broadcast(stop, 0)
        done = bool(stop.item())
        warm = min(1.0, (step + 1) / 150)
        for group in opt.param_groups:
            group["lr"] = args.lr * group["k"] * warm * (0.5 + 0.5 * math.cos(math.pi * min(t, 1)) + 0.01)
        net.train()
        pictures = photos.batch(args.photos)
        if rooms is not None:
            r = rooms.views(args.rooms, SIDE)
            pictures = [torch.cat([a, b.to(a.dtype)]) for a, b in zip(pictures, r)]
        # Up to three real things over a photograph or a rendered room.
        for number in range(step % 4):
            pictures = photos.paste(*pictures, photos.batch(len(pictures[0]), things=True), number)
        rgb, whole, part = pictures
        loss, iou = loss_of(model, rgb, whole, part, gen)
        opt.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        if torch.isfinite(norm):
            opt.step()
        decay = min(0.999, (step + 1) / (step + 10))
        torch._foreach_lerp_(kept, live, 1 - decay)
        sums += torch.stack([loss.detach(), iou.detach(), norm.detach()])
        n += 1
        step += 1
        if step % 100 == 0 and rank == 0:
            s = (sums / n).tolist()
            print(f"step {step} {time.time() - begin:.0f}s loss {s[0]:.4f} iou {s[1]:.3f} norm {s[2]:.2f}", flush=True)
            log.write(json.dumps({"step": step, "seconds": round(time.time() - begin, 1), "loss": s[0], "iou": s[1]}) + "\n")
            sums.zero_()
            n = 0
        if t > next_eval and rank == 0:
            evaluate(f"at {t:.2f}")
        if t > next_eval:
            next_eval += 9
    if rank == 0:
        state = {k: v.half().cpu() if v.is_floating_point() else v.cpu() for k, v in ema.state_dict().items()}
        torch.save(state, os.path.join(args.out, "masks.pt"))
        print("trained", step, "steps", flush=True)
        evaluate("end")
        if args.look:
            for f in sorted(os.listdir(args.look)):
                if f.endswith(".jpg"):
                    pic, count = look(ema, os.path.join(args.look, f), device)
                    pic.save(os.path.join(args.out, "look_" + f), quality=85)
                    print(f, count, flush=True)
    dist.barrier()
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
