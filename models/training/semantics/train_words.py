"""Trains the image tower, and the turn of MiniLM's space that it shares with the text tower.

    torchrun --standalone --nproc-per-node N train_words.py --pack PACK --out OUT --seconds S

Pictures: labelled photographs (whole, or under a random blob), drawn segments with names, and named
meshes of rendered scenes cut out by their exact masks; walls and nameless shapes are pictures of
nothing. Losses: cross entropy over the names; a sigmoid for every word against the product's own
threshold (the nearest canon phrase), true and open words by WordNet; EfficientNet-Lite2's opinion of
the uncut picture; and the turned space must keep what is near what in MiniLM's.
"""
import argparse
import io
import json
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import torch.distributed as dist
import torch.nn as nn
import torch.nn.functional as F
from PIL import Image

from colours import dominant_colour
from lite import Lite2
from minilm import MiniLM, embed_all
from views import KIND, Rooms, extension, join, regions
from words_model import SIDE, SPACE, ImageTower

STORE = 192
NOTHING = "wall floor ceiling box ball table frame board panel picture cloth plate bar divider partition shelf cube sphere cylinder pole carpet rug curtain".split()


def letterbox(img, size):
    """A picture in the middle of a black square; with it which pixels are the picture."""
    k = size / max(img.size)
    small = img.resize((max(1, round(img.width * k)), max(1, round(img.height * k))), Image.BILINEAR)
    out = Image.new("RGB", (size, size))
    out.paste(small, ((size - small.width) // 2, (size - small.height) // 2))
    return np.asarray(out)


def photographs(path):
    z = np.load(path)
    blob, off = z["blob"].tobytes(), z["offsets"]
    with ThreadPoolExecutor(16) as pool:
        pics = list(pool.map(lambda i: letterbox(Image.open(io.BytesIO(blob[off[i] : off[i + 1]])).convert("RGB"), STORE), range(len(off) - 1)))
    return np.stack(pics), z["label"], z["source"]


def segments(data, part, words):
    """Drawn segments: [K,192,192,4] (colour and mask) and the class of each."""
    pics, label = [], []
    for source, rgb, whole, _, names in regions(data, part, ("coco_panoptic_200", "camvid", "human_seg")):
        for k in np.unique(whole[whole >= 0]):
            mask = whole == k
            if mask.sum() < 0.003 * mask.size:
                continue
            if source == "coco_panoptic_200":
                c = words["coco"][names[int(k)]]
            elif source == "camvid":
                i = int(names["class_of"][mask][0])
                if i >= len(words["camvid"]):
                    continue
                c = words["camvid"][i]
            else:
                c = words["person"]
            ys, xs = np.nonzero(mask)
            y0, y1, x0, x1 = ys.min(), ys.max() + 1, xs.min(), xs.max() + 1
            crop = Image.fromarray(rgb[y0:y1, x0:x1])
            m = Image.fromarray((mask[y0:y1, x0:x1] * 255).astype(np.uint8)).convert("RGB")
            pics.append(np.concatenate([letterbox(crop, STORE), letterbox(m, STORE)[..., :1]], -1))
            label.append(c)
    return np.stack(pics), np.array(label)


class Words:
    """The vocabulary in the teacher's space, and what is true (1), open (-1) or false (0) of each class."""

    def __init__(self, pack, device):
        self.data = json.load(open(os.path.join(pack, "words.json")))
        z = np.load(os.path.join(pack, "phrases.npz"))
        get = lambda n: torch.from_numpy(z[n].astype(np.int64)).to(device)
        n = len(self.data["words"]) + 3
        at = get("theirs_at")[: n + 1]
        every = embed_all(MiniLM(os.path.join(pack, "minilm.npz"), device), get("theirs"), at, device)
        self.canon, self.words = every[:3], every[3:]
        classes = self.data["classes"]
        self.truth = torch.zeros(len(classes) + 1, n - 3, dtype=torch.int8, device=device)
        own = torch.tensor([c["own"] for c in classes], device=device)
        # Words that mean nearly the same to the teacher are left open, unless they are true.
        for i, c in enumerate(classes):
            near = (self.words @ self.words[c["own"]]) > 0.62
            self.truth[i] = torch.where(near, -1, 0)
            self.truth[i, torch.tensor(c["open"], dtype=torch.long, device=device)] = -1
            self.truth[i, torch.tensor(c["true"], dtype=torch.long, device=device)] = 1
        index = {w: i for i, w in enumerate(self.data["words"])}
        for w in NOTHING:
            if w in index:
                self.truth[-1] = torch.where((self.words @ self.words[index[w]]) > 0.5, -1, self.truth[-1])
        self.colours = torch.tensor(self.data["colours"], device=device)
        self.truth[:, self.colours] = -1
        self.nothing = len(classes)
        # Classes of one name are one in the cross entropy.
        self.own_words, self.own_of = torch.unique(own, return_inverse=True)
        self.thousand = own[torch.tensor(self.data["thousand"], device=device)]


class Space(nn.Module):
    """The turn: unit([m - centre] turnᵀ); the canon is free; two scales."""

    def __init__(self, words):
        super().__init__()
        self.register_buffer("centre", words.words.mean(0))
        self.turn = nn.Parameter(torch.eye(SPACE, device=words.words.device))
        self.canon = nn.Parameter(F.normalize(words.canon - self.centre, dim=-1))
        self.scale = nn.Parameter(torch.tensor([math.log(20.0), math.log(20.0)]))

    def forward(self, m):
        return F.normalize((m - self.centre) @ self.turn.T, dim=-1)


def blobs(B, S, gen, device):
    """Smooth random shapes around the middle, [B,1,S,S]."""
    u = lambda *s: torch.rand(*s, device=device, generator=gen)
    g = torch.linspace(-1, 1, S, device=device)
    x, y = g[None, None].expand(B, S, S), g[None, :, None].expand(B, S, S)
    cx, cy = ((u(B, 1, 1) - 0.5) * 0.3 for _ in range(2))
    rx, ry = (0.5 + u(B, 1, 1) * 0.6 for _ in range(2))
    noise = F.interpolate(torch.randn(B, 1, 6, 6, device=device, generator=gen), (S, S), mode="bicubic")[:, 0] * 0.22
    p = 2 + u(B, 1, 1) * 3
    return ((((x - cx) / rx).abs() ** p + ((y - cy) / ry).abs() ** p + noise) < 1).float()[:, None]


class Pictures:
    """Batches of cut-out pictures: what the tower sees, what its teacher sees, class, mask."""

    def __init__(self, pack, words, device, seed, rooms):
        pics, label, source = photographs(os.path.join(pack, "photos.npz"))
        self.photos, self.photo_class = torch.from_numpy(pics).to(device), torch.from_numpy(label).long().to(device)
        # Tiny photographs are many and blurred: one of them counts less.
        self.photo_weight = torch.tensor([1.0, 1.3, 3.0, 3.0], device=device)[torch.from_numpy(source).long().to(device)]
        seg, cls = segments(pack, "train", words.data)
        self.segments, self.segment_class = torch.from_numpy(seg).to(device), torch.from_numpy(cls).long().to(device)
        self.segment_weight = 1 / torch.bincount(self.segment_class)[self.segment_class].float() ** 0.5
        self.words, self.device, self.rooms = words, device, rooms
        self.gen = torch.Generator(device=device).manual_seed(seed)
        self.mesh_class = torch.full((max(rooms.names) + 2,), words.nothing, device=device)
        for m, name in rooms.names.items():
            self.mesh_class[m] = words.data["mesh"][name]

    def u(self, *s):
        return torch.rand(*s, device=self.device, generator=self.gen)

    def warp(self, x, mode="bilinear"):
        """The same random small affine move of every channel; [B,C,h,w] -> [B,C,S,S]."""
        B = len(x)
        a = (self.u(B) - 0.5) * 0.5
        k = torch.exp((self.u(B) - 0.55) * 0.45)
        f = torch.where(self.u(B) < 0.5, -1.0, 1.0)
        stretch = torch.exp((self.u(B) - 0.5) * 0.25)
        theta = torch.stack([
            torch.stack([k * f * stretch * a.cos(), -k * a.sin(), (self.u(B) - 0.5) * 0.25], -1),
            torch.stack([k * f * a.sin(), k / stretch * a.cos(), (self.u(B) - 0.5) * 0.25], -1),
        ], 1)
        return F.grid_sample(x, F.affine_grid(theta, (B, 1, SIDE, SIDE), align_corners=False), align_corners=False)

    def recolour(self, x):
        B = len(x)
        gain = torch.exp((self.u(B, 3, 1, 1) - 0.5) * 0.15 + (self.u(B, 1, 1, 1) - 0.5) * 0.5)
        c = torch.exp((self.u(B, 1, 1, 1) - 0.5) * 0.4)
        return (((x * gain) - 0.4) * c + 0.4).clamp(0, 1)

    @torch.no_grad()
    def batch(self, nphoto, nseg, nroom):
        pick = torch.multinomial(self.photo_weight, nphoto, True, generator=self.gen)
        x = self.warp(self.photos[pick].permute(0, 3, 1, 2).float() / 255)
        keep = torch.where(self.u(nphoto, 1, 1, 1) < 0.5, torch.ones_like(x[:, :1]), blobs(nphoto, SIDE, self.gen, self.device))
        out = [(x, keep, self.photo_class[pick])]
        pick = torch.multinomial(self.segment_weight, nseg, True, generator=self.gen)
        y = self.warp(self.segments[pick].permute(0, 3, 1, 2).float() / 255)
        out.append((y[:, :3], self.ragged_edge(y[:, 3:], 0.2), self.segment_class[pick]))
        out.append(self.cut_outs(nroom))
        x, keep, cls = (torch.cat(p) for p in zip(*out))
        x = self.recolour(x)
        return x, keep, cls

    def ragged_edge(self, mask, whole):
        """Masks as a network draws them: a little too small or too large; at times no mask at all."""
        B = len(mask)
        soft = F.avg_pool2d(F.pad(mask, (4, 4, 4, 4)), 9, 1)
        cut = (soft > 0.2 + self.u(B, 1, 1, 1) * 0.6).float()
        return torch.where(self.u(B, 1, 1, 1) < whole, torch.ones_like(cut), cut)

    def cut_outs(self, n):
        S = 384
        rgb, ids, _, mesh = self.rooms.views(max(n // 5, 1), S)
        B = len(rgb)
        # A pixel of each wanted instance, larger ones as likely as smaller ones.
        flat = ids[:, 1::3, 1::3].reshape(B, -1)
        rows = []
        for b in range(B):
            v, inverse, counts = torch.unique(flat[b], return_inverse=True, return_counts=True)
            ok = (counts > 0.004 * flat.shape[1]) & (v >= 0)
            # Things first, a wall at times.
            w = ok.float() * torch.where(v >= 64, 0.12, 1.0)
            if w.sum() > 0:
                take = torch.multinomial(w, min(6, int(ok.sum())), False, generator=self.gen)
                rows += [(b, int(v[t])) for t in take.tolist() if w[t] > 0]
        pics, cls = [], []
        # Always `n` of them: a changing size would have every kernel tuned again.
        for b, v in (rows * n)[:n]:
            m = ids[b] == v
            ys, xs = torch.nonzero(m.any(1))[:, 0], torch.nonzero(m.any(0))[:, 0]
            y0, y1, x0, x1 = int(ys[0]), int(ys[-1]) + 1, int(xs[0]), int(xs[-1]) + 1
            side = max(y1 - y0, x1 - x0)
            grid_y = ((y0 + y1) / 2 + (torch.arange(STORE, device=self.device) + 0.5 - STORE / 2) * side / STORE) / S * 2 - 1
            grid_x = ((x0 + x1) / 2 + (torch.arange(STORE, device=self.device) + 0.5 - STORE / 2) * side / STORE) / S * 2 - 1
            grid = torch.stack([grid_x[None].expand(STORE, STORE), grid_y[:, None].expand(STORE, STORE)], -1)
            both = torch.cat([rgb[b], m[None].float()])
            pics.append(F.grid_sample(both[None], grid[None], align_corners=False)[0])
            cls.append(self.mesh_class[mesh[b, v]] if v < 64 and mesh[b, v] >= 0 else torch.tensor(self.words.nothing, device=self.device))
        y = self.warp(torch.stack(pics))
        return y[:, :3], self.ragged_edge(y[:, 3:], 0.05), torch.stack(cls)


def normalised(x):
    return (x * 255 - 127) / 128


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True)
    ap.add_argument("--init", help="words.pt of an earlier run; with it the space is that run's and stays")
    ap.add_argument("--space", help="space.pt of that run")
    ap.add_argument("--back", type=float, default=0.0, help="share of the way back from --init to EfficientNet-Lite2 where the run starts")
    ap.add_argument("--look", help="uint8 crops [K,3,S,S] (torch.save) to show words of, never trained on")
    ap.add_argument("--lr", type=float, default=4e-4)
    ap.add_argument("--batch", type=int, nargs=3, default=[160, 64, 48])
    args = ap.parse_args()
    rank, world, device = join()
    torch.manual_seed(50 + rank)
    torch.backends.cuda.matmul.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    start = time.time()
    words = Words(args.pack, device)
    rooms = Rooms(extension(), args.pack, device, 500 + rank)
    pictures = Pictures(args.pack, words, device, 600 + rank, rooms)
    held = None
    if rank == 0:
        pics, label, _ = photographs(os.path.join(args.pack, "photos_held.npz"))
        seg, seg_class = segments(args.pack, "heldout", words.data)
        held = (torch.from_numpy(pics).to(device), torch.from_numpy(label).long().to(device), torch.from_numpy(seg).to(device), torch.from_numpy(seg_class).long().to(device))
    teacher = Lite2().load(os.path.join(args.pack, "lite2.pt")).to(device).eval().to(memory_format=torch.channels_last)
    tower = ImageTower()
    state = torch.load(os.path.join(args.pack, "lite2.pt"), map_location="cpu")
    tower.body.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items() if not k.startswith("_fc")})
    # Start where the untrained scoring is: the features that vote for a name point at the name.
    with torch.no_grad():
        names = F.normalize(words.words[words.thousand] - words.words.mean(0), dim=-1).cpu()
        fc = state["_fc.weight"].float()
        tower.out.weight.copy_((names.T @ (fc - fc.mean(0))) / 60)
        tower.out.bias.zero_()
    space = Space(words)
    if args.init:
        begun = {k[6:]: v.float() if v.is_floating_point() else v for k, v in torch.load(args.init, map_location="cpu").items()}
        first = tower.state_dict()
        tower.load_state_dict({k: v + args.back * (first[k] - v) if v.is_floating_point() else v for k, v in begun.items()})
        space.load_state_dict(torch.load(args.space, map_location=device))
        space.turn.requires_grad_(False)
        space.canon.requires_grad_(False)
    fc = teacher.requires_grad_(False)._fc
    both = nn.ModuleDict({"tower": tower, "space": space}).to(device)

    class All(nn.Module):
        def __init__(self):
            super().__init__()
            self.both = both

        def forward(self, x):
            with torch.autocast(KIND, dtype=torch.bfloat16):
                features = self.both["tower"].body.head(x)
                f = self.both["tower"].embed(features)
                # Features as EfficientNet-Lite2 would have of each of its thousand classes: pictures of
                # most of them are not here, what it knows of them is in its last matrix.
                n = torch.randint(0, 1000, (384,), device=x.device)
                base = features.detach()[torch.randint(0, len(features), (384,), device=x.device)].float()
                push = 6 + 8 * torch.rand(384, 1, device=x.device)
                made = (0.6 * base + push * fc.weight[n] / fc.weight[n].square().sum(1, keepdim=True)).clamp(min=0)
                g = self.both["tower"].embed(made)
                said = fc(features).float()
            return f, g, n, said, self.both["space"](words.words), F.normalize(self.both["space"].canon, dim=-1), self.both["space"].scale.exp()

    net = All().to(memory_format=torch.channels_last)
    ema = {k: v.detach().clone() for k, v in both.state_dict().items()}
    live = [v for v in both.state_dict().values() if v.is_floating_point()]
    kept = [ema[k] for k, v in both.state_dict().items() if v.is_floating_point()]
    heads = [p for n, p in both.named_parameters() if not n.startswith("tower.body")]
    heads = [p for p in heads if p.requires_grad]
    opt = torch.optim.AdamW([{"params": list(tower.body.parameters()), "k": 0.5, "weight_decay": 0.03}, {"params": heads, "k": 2.0, "weight_decay": 0.0}], lr=args.lr, betas=(0.9, 0.99))
    model = torch.nn.parallel.DistributedDataParallel(net, device_ids=[device.index] if device.type == "cuda" else None, broadcast_buffers=False)
    os.makedirs(args.out, exist_ok=True)
    log = open(os.path.join(args.out, f"words{rank}.jsonl"), "w")
    centred = F.normalize(words.words - words.words.mean(0), dim=-1)
    if rank == 0 and args.init:
        print("from", args.init, "back", args.back, flush=True)
    if rank == 0:
        print("ready", round(time.time() - start, 1), "photos", len(pictures.photos), "segments", len(pictures.segments), flush=True)
    begin, step, sums, n, done, next_eval = time.time(), 0, torch.zeros(6, device=device), 0, False, 0.4

    @torch.no_grad()
    def evaluate(tag):
        keep = {k: v.clone() for k, v in both.state_dict().items()}
        both.load_state_dict(ema)
        both.eval()
        t, canon = space(words.words), F.normalize(space.canon, dim=-1)
        own = t[words.own_words]
        out = {}

        def run(x, keep_mask, cls, name):
            with torch.autocast(KIND, dtype=torch.bfloat16):
                f = torch.cat([tower(normalised(a * m)) for a, m in zip(x.split(256), keep_mask.split(256))])
                p = torch.cat([teacher._fc(teacher.head(normalised(a * m))).float() for a, m in zip(x.split(256), keep_mask.split(256))]).softmax(-1)
            top, at = p.topk(10, -1)
            raw = F.normalize((top[..., None] * words.words[words.thousand][at]).sum(1), dim=-1)
            want = words.own_of[cls]
            rank_of = lambda s: (s > s.gather(1, want[:, None])).sum(1)
            mine, theirs = rank_of(f @ own.T), rank_of(raw @ words.words[words.own_words].T)
            z = f @ t.T - (f @ canon.T).amax(1, keepdim=True)
            truth = words.truth[cls]
            raw_z = raw @ words.words.T - (raw @ words.canon.T).amax(1, keepdim=True)
            named = torch.arange(len(words.words), device=device) < words.data["named"]
            share = lambda z_, v: round(float((z_ >= 0)[(truth == v) & named].float().mean()), 3)
            out[name] = {
                "top1": round(float((mine < 1).float().mean()), 3), "top5": round(float((mine < 5).float().mean()), 3),
                "untrained": [round(float((theirs < k).float().mean()), 3) for k in (1, 5)],
                "own found": round(float((z.gather(1, words.own_words[want][:, None]) >= 0).float().mean()), 3),
                "true found": share(z, 1), "false found": share(z, 0), "untrained found": [share(raw_z, 1), share(raw_z, 0)],
            }

        x = F.interpolate(held[0].permute(0, 3, 1, 2).float() / 255, (SIDE, SIDE), mode="bilinear")
        run(x, torch.ones_like(x[:, :1]), held[1], "photos")
        g = torch.Generator(device=device).manual_seed(3)
        run(x, blobs(len(x), SIDE, g, device), held[1], "photos cut")
        y = F.interpolate(held[2].permute(0, 3, 1, 2).float() / 255, (SIDE, SIDE), mode="bilinear")
        run(y[:, :3], (y[:, 3:] > 0.5).float(), held[3], "segments")
        print(tag, json.dumps(out), flush=True)
        log.write(json.dumps({"step": step, "held": out}) + "\n")
        log.flush()
        if args.look:
            crops = torch.load(args.look, map_location=device).float() / 255
            with torch.autocast(KIND, dtype=torch.bfloat16):
                f = tower(normalised(crops))
            for i, row in enumerate(f.float()):
                score = t[: words.data["named"]] @ row
                print(i, f"canon {float((canon @ row).max()):.2f}", [(words.data["words"][j], round(float(score[j]), 2)) for j in score.topk(7).indices.tolist()], flush=True)
        both.load_state_dict(keep)

    if rank == 0 and args.init:
        evaluate("start")
    begin = time.time()
    while not done:
        t = (time.time() - begin) / args.seconds
        stop = torch.tensor([float(t >= 1)], device=device)
        dist.broadcast(stop, 0)
        done = bool(stop.item())
        for group in opt.param_groups:
            group["lr"] = args.lr * group["k"] * min(1, (step + 1) / 200) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * min(t, 1))))
        both.train()
        x, keep, cls = pictures.batch(*args.batch)
        with torch.no_grad(), torch.autocast(KIND, dtype=torch.bfloat16):
            opinion = teacher._fc(teacher.head(normalised(x).contiguous(memory_format=torch.channels_last))).float()
        f, g, made_of, said, tw, canon, scale = model(normalised(x * keep).contiguous(memory_format=torch.channels_last))
        named = cls != words.nothing
        cos = f @ tw.T
        # 1: which of the names.
        want = words.own_of[cls.clamp(max=words.nothing - 1)]
        ce_logits = scale[0] * cos[:, words.own_words]
        other = words.truth[cls][:, words.own_words] != 0
        other = other & ~F.one_hot(want, len(words.own_words)).bool()
        ce = F.cross_entropy(ce_logits.masked_fill(other, -1e4), want, reduction="none", label_smoothing=0.0)
        ce = (ce * named).sum() / named.sum()
        # 2: the product's own question, for every word.
        margin = (cos - (f @ canon.T).amax(1, keepdim=True)) * scale[1].clamp(max=40)
        truth = words.truth[cls].clone()
        colour = dominant_colour(x, keep)
        is_cut = torch.arange(len(cls), device=device) >= args.batch[0]
        truth[:, words.colours] = torch.where(is_cut[:, None], colour, -1).to(truth.dtype)
        pos, neg = (truth == 1).float(), (truth == 0).float()
        # Half of what is true is the name itself, half what it is a kind of.
        itself = F.one_hot(words.own_words[want], pos.shape[1]) * named[:, None] * pos
        rest = pos - itself
        p_loss = F.softplus(-margin) * (itself + rest / rest.sum(1, keepdim=True).clamp(min=1))
        p_loss = p_loss.sum(1) / 2
        # Thousands of words are false of a picture: those that come near count most.
        near = neg * (margin.detach().sigmoid() + 0.01)
        n_loss = (F.softplus(margin) * near).sum(1) / near.sum(1).clamp(min=1e-3)
        bce = (2 * p_loss + 1.5 * n_loss).mean()
        # 3: the teacher's opinion of the whole picture.
        kd = F.kl_div((scale[0] * cos[:, words.thousand]).log_softmax(-1), (opinion / 1.5).softmax(-1), reduction="none").sum(-1)
        kd = (kd * torch.where(is_cut, 0.3, 1.0)).mean()
        # The features stay what the teacher's last matrix can read, and its classes keep their names.
        kd = kd + 0.5 * F.kl_div((said / 1.5).log_softmax(-1), (opinion / 1.5).softmax(-1), reduction="none").sum(-1).mean()
        made_cos = g @ tw[words.thousand].T
        made_margin = made_cos.gather(1, made_of[:, None])[:, 0] - (g @ canon.T).amax(1)
        made_loss = F.cross_entropy(scale[0] * made_cos, made_of) + F.softplus(-made_margin * scale[1].clamp(max=40)).mean()
        # 4: what was near stays near.
        pick = torch.randint(0, len(tw), (768,), device=device)
        keep_near = ((tw[pick] @ tw[pick].T - centred[pick] @ centred[pick].T) ** 2).mean()
        loss = ce + bce + 0.7 * kd + 0.4 * made_loss + 8 * keep_near
        opt.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(both.parameters(), 2.0)
        if torch.isfinite(norm):
            opt.step()
        with torch.no_grad():
            d = min(0.9985, (step + 1) / (step + 10))
            torch._foreach_lerp_(kept, live, 1 - d)
        sums += torch.stack([loss.detach(), ce.detach(), bce.detach(), kd.detach(), keep_near.detach(), scale[0].detach()])
        n += 1
        step += 1
        if step % 200 == 0 and rank == 0:
            s = (sums / n).tolist()
            print(f"words step {step} {time.time() - begin:.0f}s loss {s[0]:.3f} ce {s[1]:.3f} bce {s[2]:.3f} kd {s[3]:.3f} near {s[4]:.4f} scale {s[5]:.1f}", flush=True)
            log.write(json.dumps({"step": step, "seconds": round(time.time() - begin, 1), "losses": [round(v, 4) for v in s]}) + "\n")
            sums.zero_()
            n = 0
        if t > next_eval:
            next_eval += 0.7
            if rank == 0:
                evaluate(f"at {t:.2f}")
    if rank == 0:
        evaluate("end")
        torch.save({k: v.half().cpu() for k, v in ema.items() if k.startswith("tower.")}, os.path.join(args.out, "words.pt"))
        torch.save({k[6:]: v.cpu() for k, v in ema.items() if k.startswith("space.")}, os.path.join(args.out, "space.pt.tmp"))
        os.rename(os.path.join(args.out, "space.pt.tmp"), os.path.join(args.out, "space.pt"))
        print("words trained", step, flush=True)
    dist.barrier()
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
