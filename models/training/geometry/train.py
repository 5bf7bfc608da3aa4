"""Trains the geometry network on scenes made on the fly; weights come out as an EMA in fp16.

    torchrun --standalone --nproc-per-node N train.py --pack PACK --out OUT --seconds S \
        [--init weights.pt] [--real realset.pt]

Loss: inverse depth relative to the searched range at three scales, cross entropy of the sweep,
then two unseen views rendered by gsplat (classic mode, as the product renders): MSE, log MSE
(the mean PSNR itself), SSIM. Everything is seeded; the schedule follows the share of time used.
"""
import argparse
import json
import math
import os
import random
import time

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch.utils.cpp_extension import load

import realset
from model import SH_C0, GeometryNet
from scenes import World

HERE = os.path.dirname(os.path.abspath(__file__))
SHAPES = [(256, 256)] * 7 + [(224, 288), (288, 224), (192, 320), (320, 192)]


def extension():
    return load("raycast", [os.path.join(HERE, "raycast.cu")], extra_cflags=["-O3"], extra_cuda_cflags=["-O3", "--use_fast_math"])


def render(out, c2w, K, H, W):
    """Pictures [B,T,3,H,W] of the network's Gaussians from cameras c2w [B,T,4,4], K normalised."""
    from gsplat import rasterization

    return rasterize(rasterization, world_gaussians(out), c2w, K, H, W)


def world_gaussians(out):
    m, R, t = out["means"], out["c2w"][..., :3, :3], out["c2w"][..., :3, 3]
    means = torch.einsum("bvij,bvhwj->bvhwi", R, m) + t[:, :, None, None]
    return {
        "means": means.flatten(1, 3), "scales": out["scales"].flatten(1, 3),
        "quats": quat_mul(rot_to_quat(R)[:, :, None, None].expand_as(out["quats"]), out["quats"]).flatten(1, 3),
        "opacities": out["opacities"].flatten(1, 3),
        "colors": (out["sh"][..., 0, :] * SH_C0 + 0.5).clamp(min=0).flatten(1, 3),
    }


def rasterize(rasterization, g, c2w, K, H, W):
    size = torch.tensor([[W], [H], [1]], device=K.device, dtype=torch.float32)
    img, _, _ = rasterization(
        g["means"], g["quats"], g["scales"], g["opacities"], g["colors"],
        torch.linalg.inv(c2w).contiguous(), (K * size).contiguous(), W, H, near_plane=1e-3, packed=False,
    )
    return img[..., :3].permute(0, 1, 4, 2, 3)


def quat_mul(a, b):
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack([
        aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
    ], -1)


def rot_to_quat(R):
    """wxyz; stable for every rotation (largest of the four components first)."""
    m = R
    t = torch.stack([
        1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2], 1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
        1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2], 1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
    ], -1)
    a, b, c = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    d, e, f = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    cand = torch.stack([
        torch.stack([t[..., 0], a - d, b - e, c - f], -1), torch.stack([a - d, t[..., 1], c + f, b + e], -1),
        torch.stack([b - e, c + f, t[..., 2], a + d], -1), torch.stack([c - f, b + e, a + d, t[..., 3]], -1),
    ], -2)
    best = t.argmax(-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    return F.normalize(torch.gather(cand, -2, best)[..., 0, :], dim=-1)


_WINDOW = {}


def ssim(x, y):
    """Mean SSIM of each picture, 11x11 Gaussian of sigma 1.5, valid windows. [M,3,H,W] -> [M]."""
    key = x.device
    if key not in _WINDOW:
        g = torch.exp(-((torch.arange(11, device=key) - 5.0) ** 2) / (2 * 1.5**2))
        _WINDOW[key] = (g / g.sum())[None, None]
    g = _WINDOW[key]
    m, c, h, w = x.shape

    def blur(t):
        t = t.reshape(m * c, 1, *t.shape[-2:])
        t = F.conv2d(F.conv2d(t, g[..., None]), g[:, :, None])
        return t.reshape(m, c, *t.shape[-2:])

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    s = ((2 * mx * my + 1e-4) * (2 * vxy + 9e-4)) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return s.flatten(1).mean(1)


def neighbors(c2w, k):
    """k nearest other views by distance of centres, then angle. [B,V,4,4] -> [B,V,k]."""
    d = torch.cdist(c2w[:, :, :3, 3], c2w[:, :, :3, 3])
    d = d + 1e6 * torch.eye(d.shape[1], device=d.device)
    return d.argsort(-1)[..., :k]


def depth_loss(out, depth, near, far):
    inv_lo, inv_hi = 1 / far, 1 / near
    u = ((1 / depth.clamp(min=1e-4) - inv_lo[..., None, None]) / (inv_hi - inv_lo)[..., None, None]).clamp(-0.1, 1.1)
    total = 0.5 * (out["u4"] - u[..., 2::4, 2::4]).abs().mean()
    total = total + 0.7 * (out["u2"] - u[..., 1::2, 1::2]).abs().mean() + (out["u1"] - u).abs().mean()
    D = out["logits"].shape[2]
    pos = (u[..., 2::4, 2::4].clamp(0, 1) * (D - 1)).flatten(0, 1)
    lo = pos.floor().clamp(max=D - 2).long()
    f = (pos - lo)[:, None]
    logp = F.log_softmax(out["logits"].flatten(0, 1), 1)
    ce = -(logp.gather(1, lo[:, None]) * (1 - f) + logp.gather(1, lo[:, None] + 1) * f).mean()
    return total, ce, (out["u1"] - u).abs().mean()


def real_eval(net, path, device, rank, world_size, pictures=None):
    """PSNR and SSIM on real photographs, never trained on; every rank takes its share."""
    data = realset.read(path)
    rows = []
    for n, item in enumerate(data["items"]):
        if n % world_size != rank:
            continue
        sc = data["scenes"][item["scene"]]
        idx = torch.tensor(item["views"])
        img = sc["images"][idx].to(device).float().permute(0, 3, 1, 2)[None] / 255
        c2w = sc["c2w"][idx].to(device).float()[None]
        tgt = sc["c2w"][item["target"]].to(device).float()[None, None]
        base = torch.linalg.inv(c2w[:, :1].double())
        c2w, tgt = (base @ c2w.double()).float(), (base @ tgt.double()).float()
        s = torch.cdist(c2w[:, :, :3, 3], c2w[:, :, :3, 3]).max()
        c2w[..., :3, 3] /= s
        tgt[..., :3, 3] /= s
        K, Kt = sc["K"][idx].to(device).float()[None], sc["K"][item["target"]].to(device).float()[None, None]
        near, far = [torch.tensor(item[k], device=device)[None].float() / s for k in ("near", "far")]
        nb = neighbors(c2w, min(len(idx) - 1, 3))
        with torch.no_grad(), torch.autocast("cuda", dtype=torch.bfloat16):
            out = net(img, K, c2w, near, far, nb)
        out["c2w"] = c2w
        with torch.no_grad():
            pic = render(out, tgt, Kt, 256, 256)[0, 0].clamp(0, 1)
            want = sc["images"][item["target"]].to(device).float().permute(2, 0, 1) / 255
            psnr = -10 * math.log10(max(((pic - want) ** 2).mean().item(), 1e-9))
            rows.append((item["scene"], len(idx), psnr, ssim(pic[None], want[None])[0].item(), item["warp"]))
        if pictures is not None and item.get("show"):
            strip = torch.cat([img[0, 0], img[0, 1], want, pic, out["u1"][0, 0].clamp(0, 1).expand(3, -1, -1)], 2)
            pictures.append((item["scene"], len(idx), strip.cpu()))
    every = [None] * world_size
    dist.all_gather_object(every, rows)
    rows = [r for part in every for r in part]
    table = {}
    for scene, v, psnr, s, warp in rows:
        table.setdefault((scene, v), []).append((psnr, s, warp))
    return {f"{k[0]}/{k[1]}": [round(sum(x[i] for x in v) / len(v), 3) for i in range(3)] + [len(v)] for k, v in sorted(table.items())}


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True)
    ap.add_argument("--init")
    ap.add_argument("--real")
    ap.add_argument("--lr", type=float, default=5e-4)
    ap.add_argument("--depth-share", type=float, default=0.08)
    ap.add_argument("--evals", type=int, default=4)
    ap.add_argument("--seed", type=int, default=1)
    ap.add_argument("--batch", type=int, default=16)
    args = ap.parse_args()
    dist.init_process_group("nccl")
    rank, ranks = dist.get_rank(), dist.get_world_size()
    torch.cuda.set_device(rank)
    device = torch.device("cuda", rank)
    torch.backends.cuda.matmul.allow_tf32 = True
    torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    os.makedirs(args.out, exist_ok=True)
    log = open(os.path.join(args.out, "log.jsonl"), "a") if rank == 0 else None

    def say(**kw):
        if log:
            log.write(json.dumps(kw) + "\n")
            log.flush()
            print(json.dumps(kw), flush=True)

    world = World(extension(), args.pack, device, 1000 * args.seed + rank)
    torch.manual_seed(args.seed)
    net = GeometryNet().to(device)
    if args.init:
        net.load_state_dict({k: v.float() for k, v in torch.load(args.init).items()})
    ema = {k: v.clone() for k, v in net.state_dict().items()}
    params = [p for p in net.parameters() if p.requires_grad]
    decay = [p for p in params if p.ndim > 1]
    rest = [p for p in params if p.ndim <= 1]
    opt = torch.optim.AdamW([{"params": decay, "weight_decay": 0.02}, {"params": rest, "weight_decay": 0.0}], lr=args.lr, betas=(0.9, 0.98), fused=True)
    start, step, skipped, next_eval, next_save = time.time(), 0, 0, 1, 200.0
    clock = torch.zeros(1, device=device)
    sums, times = {}, {}

    def evaluate(tag, final=False):
        keep = {k: v.clone() for k, v in net.state_dict().items()}
        net.load_state_dict(ema)
        pics = [] if final else None
        table = real_eval(net, args.real, device, rank, ranks, pics)
        net.load_state_dict(keep)
        say(eval=tag, step=step, t=round(time.time() - start), table=table)
        if final and pics:
            torch.save(pics, os.path.join(args.out, f"pics{rank}.pt"))

    def save():
        if rank == 0:
            torch.save({k: v.half() for k, v in ema.items()}, os.path.join(args.out, "ema.tmp"))
            os.replace(os.path.join(args.out, "ema.tmp"), os.path.join(args.out, "ema.pt"))

    while True:
        if step % 10 == 0:  # one clock for all ranks
            clock.fill_(time.time() - start)
            dist.broadcast(clock, 0)
            elapsed = clock.item()
        share = elapsed / args.seconds
        if share >= 1:
            break
        if args.real and share > next_eval / args.evals and next_eval < args.evals:
            evaluate(next_eval)
            next_eval += 1
        if elapsed > next_save:
            save()
            next_save += 200
        draw = random.Random(args.seed * 1000003 + step)
        depth_only = share < args.depth_share and not args.init
        wide = 1.0 if args.init else min(max((share - 0.08) / 0.4, 0.0), 1.0)
        V = draw.choices([2, 3, 4], [0.55, 0.2, 0.25])[0]
        H, W = draw.choice(SHAPES)
        B = max(args.batch * 2 // V, 1)
        t0 = time.time()
        with torch.no_grad():
            rgb, depth, K, c2w, near, far = world.batch(B, V, 2, H, W, wide)
        warm = min(1.0, (step + 1) / 200)
        lr = args.lr * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(share, 1))))
        for gparam in opt.param_groups:
            gparam["lr"] = lr
        with torch.autocast("cuda", dtype=torch.bfloat16):
            out = net(rgb[:, :V], K[:, :V], c2w[:, :V], near, far, neighbors(c2w[:, :V], min(V - 1, 3)))
        dl, ce, err = depth_loss(out, depth[:, :V], near, far)
        loss = dl + 0.05 * ce
        mse = torch.zeros((), device=device)
        if not depth_only:
            out["c2w"] = c2w[:, :V]
            pic = render(out, c2w[:, V:], K[:, V:], H, W).flatten(0, 1)
            want = rgb[:, V:].flatten(0, 1)
            each = ((pic - want) ** 2).flatten(1).mean(1)
            mse = each.mean()
            loss = 0.25 * (dl + 0.05 * ce) + 6 * mse + 0.02 * torch.log(each + 1e-4).mean() + 0.15 * (1 - ssim(pic, want)).mean()
        opt.zero_grad(set_to_none=False)
        loss.backward()
        flat = torch.cat([(p.grad if p.grad is not None else torch.zeros_like(p)).flatten() for p in params])
        dist.all_reduce(flat)
        flat /= ranks
        norm = flat.norm()
        if torch.isfinite(norm):
            flat *= min(1.0, 1.0 / (norm.item() + 1e-6))
            at = 0
            for p in params:
                if p.grad is None:
                    p.grad = torch.empty_like(p)
                p.grad.copy_(flat[at : at + p.numel()].view_as(p))
                at += p.numel()
            opt.step()
        else:
            skipped += 1
        step += 1
        d = min(0.999, (step + 1) / (step + 20))
        with torch.no_grad():
            sd = net.state_dict()
            torch._foreach_lerp_([ema[k] for k in sd], list(sd.values()), 1 - d)
        key = f"psnr{V}"
        if not depth_only:
            a = sums.setdefault(key, [0.0, 0])
            a[0] += -10 * math.log10(max(mse.item(), 1e-9))
            a[1] += 1
        a = sums.setdefault("depth", [0.0, 0])
        a[0] += err.item()
        a[1] += 1
        if step % 50 == 0:
            say(step=step, t=round(time.time() - start, 1), lr=round(lr, 6), wide=round(wide, 2), skipped=skipped, norm=round(norm.item(), 3), mem=torch.cuda.max_memory_allocated() >> 20, **{k: round(v[0] / v[1], 4) for k, v in sums.items()})
            sums = {}
    save()
    if args.real:
        evaluate("final", True)
    say(done=True, step=step, skipped=skipped)
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
