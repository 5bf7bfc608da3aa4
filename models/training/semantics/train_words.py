"""Trains the image tower, and the turn of MiniLM's space that it shares with the text tower.

    torchrun --standalone --nproc-per-node N train_words.py --pack PACK --out OUT --seconds S

Pictures: labelled photographs (whole, or under a random blob), drawn segments with names, and named
meshes of rendered scenes cut out by their exact masks; walls and nameless shapes are pictures of
nothing. Losses: cross entropy over the names; a sigmoid for every word against the product's own
threshold (the nearest canon phrase), true and open words by WordNet; EfficientNet-Lite2's opinion of
the uncut picture; and the turned space must keep what is near what in MiniLM's.
"""
import argparse
import json
import math
import os
import time

import numpy as np
import torch
import torch.distributed as dist
import torch.nn as nn
import torch.nn.functional as F
from PIL import Image

from colours import dominant_colour
from lite import Lite2
from losses import Steps, imagined, imagined_loss, mean_of, opinion_loss, saved, which_name, which_words
from minilm import MiniLM, embed_all
from pictures import POOL, decode, letterbox
from towers import normalised
from views import KIND, Rooms, extension, join, regions
from words_model import SIDE, SPACE, ImageTower

STORE = 192
IMAGINED = 384  # features of EfficientNet-Lite2's classes, a step
NOTHING = "wall floor ceiling box ball table frame board panel picture cloth plate bar divider partition shelf cube sphere cylinder pole carpet rug curtain".split()


def photographs(path):
    z = np.load(path)
    return np.stack(list(POOL.map(lambda a: letterbox(a, STORE, Image.BILINEAR), decode(z)))), z["label"], z["source"]


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
            m = np.repeat((mask[y0:y1, x0:x1, None] * 255).astype(np.uint8), 3, -1)  # not RGBA: alpha would weigh the colours
            crop, m = (letterbox(a, STORE, Image.BILINEAR) for a in (rgb[y0:y1, x0:x1], m))
            pics.append(np.concatenate([crop, m[..., :1]], -1))
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


class Network(nn.Module):
    """The tower and the space, and all that a step asks of them."""

    def __init__(self, tower, space, words, fc):
        super().__init__()
        self.both, self.words, self.fc = nn.ModuleDict({"tower": tower, "space": space}), words, [fc]  # a list: `fc` is not trained

    def forward(self, x):
        """Of pictures: embeddings, those of imagined features and their classes, EfficientNet-Lite2's logits of the features;
        the words and the canon in the space, the two scales."""
        tower, space, fc = self.both["tower"], self.both["space"], self.fc[0]
        with torch.autocast(KIND, dtype=torch.bfloat16):
            features = tower.body.head(x)
            f = tower.embed(features)
            made, of = imagined(tower.embed, features, fc, IMAGINED)
            said = fc(features).float()
        return f, made, of, said, space(self.words.words), F.normalize(space.canon, dim=-1), space.scale.exp()


def losses(words, pictures, opinion, out, is_cut, near):
    """All, names, words, EfficientNet-Lite2's opinion, nearness. `pictures`: what the tower sees, masks, classes; `near`: the words as they
    were near to one another in MiniLM's space."""
    x, keep, cls = pictures
    f, made, of, said, text, canon, scale = out
    named, want, cos = cls != words.nothing, words.own_of[cls.clamp(max=words.nothing - 1)], f @ text.T
    ce = mean_of(which_name(cos, want, words.truth[cls], words.own_words, scale[0]), named)
    margin = (cos - (f @ canon.T).amax(1, keepdim=True)) * scale[1].clamp(max=40)
    truth = words.truth[cls].clone()
    truth[:, words.colours] = torch.where(is_cut[:, None], dominant_colour(x, keep), -1).to(truth.dtype)
    bce = which_words(margin, truth, words.own_words[want]).mean()
    kd = (opinion_loss(scale[0] * cos[:, words.thousand], opinion) * torch.where(is_cut, 0.3, 1.0)).mean()
    # The features stay what the teacher's last matrix can read, and its classes keep their names.
    kd = kd + 0.5 * opinion_loss(said / 1.5, opinion).mean()
    unreal = imagined_loss(made, of, text[words.thousand], canon, scale)
    # What was near stays near.
    pick = torch.randint(0, len(text), (768,), device=text.device)
    keep_near = ((text[pick] @ text[pick].T - near[pick] @ near[pick].T) ** 2).mean()
    return ce + bce + 0.7 * kd + 0.4 * unreal + 8 * keep_near, ce, bce, kd, keep_near


class Held:
    """Held-out photographs, whole and under a blob, and drawn segments; figures of the mean weights of a network."""

    def __init__(self, pack, words, teacher, device):
        pics, label, _ = photographs(os.path.join(pack, "photos_held.npz"))
        seg, seg_class = segments(pack, "heldout", words.data)
        sized = lambda a: F.interpolate(torch.from_numpy(a).to(device).permute(0, 3, 1, 2).float() / 255, (SIDE, SIDE), mode="bilinear")
        x, y = sized(pics), sized(seg)
        label, seg_class = (torch.from_numpy(c).long().to(device) for c in (label, seg_class))
        blob = blobs(len(x), SIDE, torch.Generator(device=device).manual_seed(3), device)
        self.sets = {"photos": (x, torch.ones_like(x[:, :1]), label), "photos cut": (x, blob, label), "segments": (y[:, :3], (y[:, 3:] > 0.5).float(), seg_class)}
        self.words, self.teacher = words, teacher
        self.named = torch.arange(len(words.words), device=device) < words.data["named"]

    @torch.no_grad()
    def figures(self, network, mean):
        """Of each set: the first and the first five of all names, what is found; `untrained`: by the teacher's ten likeliest names."""
        both = network.both
        live = {k: v.clone() for k, v in both.state_dict().items()}
        both.load_state_dict(mean)
        both.eval()
        text, canon = both["space"](self.words.words), F.normalize(both["space"].canon, dim=-1)
        out = {k: self.of_set(both["tower"], text, canon, *v) for k, v in self.sets.items()}
        both.load_state_dict(live)
        return out

    def of_set(self, tower, text, canon, x, keep, cls):
        w = self.words
        parts = [normalised(a * m) for a, m in zip(x.split(256), keep.split(256))]
        with torch.autocast(KIND, dtype=torch.bfloat16):
            f = torch.cat([tower(a) for a in parts])
            p = torch.cat([self.teacher._fc(self.teacher.head(a)).float() for a in parts]).softmax(-1)
        top, at = p.topk(10, -1)
        raw = F.normalize((top[..., None] * w.words[w.thousand][at]).sum(1), dim=-1)
        want = w.own_of[cls]
        rank_of = lambda s: (s > s.gather(1, want[:, None])).sum(1)
        mine, theirs = rank_of(f @ text[w.own_words].T), rank_of(raw @ w.words[w.own_words].T)
        z = f @ text.T - (f @ canon.T).amax(1, keepdim=True)
        raw_z = raw @ w.words.T - (raw @ w.canon.T).amax(1, keepdim=True)
        truth, first = w.truth[cls], lambda rank, k: round(float((rank < k).float().mean()), 3)
        share = lambda z_, v: round(float((z_ >= 0)[(truth == v) & self.named].float().mean()), 3)
        return {
            "top1": first(mine, 1), "top5": first(mine, 5), "untrained": [first(theirs, 1), first(theirs, 5)],
            "own found": round(float((z.gather(1, w.own_words[want][:, None]) >= 0).float().mean()), 3),
            "true found": share(z, 1), "false found": share(z, 0), "untrained found": [share(raw_z, 1), share(raw_z, 0)],
        }


class Run:
    """One process of a run: its device, its log."""

    def __init__(self, args):
        self.args, self.start = args, time.time()
        self.rank, _, self.device = join()
        os.makedirs(args.out, exist_ok=True)
        self.log = open(os.path.join(args.out, f"words{self.rank}.jsonl"), "w")

    def tell(self, *what):
        if self.rank == 0:
            print(*what, flush=True)

    def note(self, **row):
        self.log.write(json.dumps(row) + "\n")
        self.log.flush()


def begun(args, words):
    """The tower and the space that a run begins with: EfficientNet-Lite2 and the untrained scoring, or --init."""
    state = torch.load(os.path.join(args.pack, "lite2.pt"), map_location="cpu")
    tower, space = ImageTower(), Space(words)
    tower.body.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items() if not k.startswith("_fc")})
    # Start where the untrained scoring is: the features that vote for a name point at the name.
    with torch.no_grad():
        names = F.normalize(words.words[words.thousand] - words.words.mean(0), dim=-1).cpu()
        fc = state["_fc.weight"].float()
        tower.out.weight.copy_((names.T @ (fc - fc.mean(0))) / 60)
        tower.out.bias.zero_()
    if args.init:
        init = {k[6:]: v.float() if v.is_floating_point() else v for k, v in torch.load(args.init, map_location="cpu").items()}
        first = tower.state_dict()
        tower.load_state_dict({k: v + args.back * (first[k] - v) if v.is_floating_point() else v for k, v in init.items()})
        space.load_state_dict(torch.load(args.space, map_location=words.words.device))
        space.turn.requires_grad_(False)
        space.canon.requires_grad_(False)
    return tower, space


def load(run):
    """Words, pictures, the held-out sets (of the first process), the teacher, the network."""
    args, device = run.args, run.device
    words = Words(args.pack, device)
    rooms = Rooms(extension(), args.pack, device, 500 + run.rank)
    pictures = Pictures(args.pack, words, device, 600 + run.rank, rooms)
    teacher = Lite2().load(os.path.join(args.pack, "lite2.pt")).to(device).eval().requires_grad_(False).to(memory_format=torch.channels_last)
    held = Held(args.pack, words, teacher, device) if run.rank == 0 else None
    network = Network(*begun(args, words), words, teacher._fc).to(device).to(memory_format=torch.channels_last)
    run.tell("ready", round(time.time() - run.start, 1), "photos", len(pictures.photos), "segments", len(pictures.segments))
    return words, pictures, held, teacher, network


def steps_of(network, lr):
    heads = [p for n, p in network.both.named_parameters() if not n.startswith("tower.body") and p.requires_grad]
    return Steps(network.both, [{"params": list(network.both["tower"].body.parameters()), "k": 0.5, "weight_decay": 0.03}, {"params": heads, "k": 2.0, "weight_decay": 0.0}],
                 lr, 200, 0.9985)


def over(seconds, begin, device):
    """The share of the run that is over, and whether the first process says that it is all."""
    t = (time.time() - begin) / seconds
    stop = torch.tensor([float(t >= 1)], device=device)
    dist.broadcast(stop, 0)
    return t, bool(stop.item())


def train(run, words, pictures, teacher, network, steps, measured):
    args, device = run.args, run.device
    model = nn.parallel.DistributedDataParallel(network, device_ids=[device.index] if device.type == "cuda" else None, broadcast_buffers=False)
    near = F.normalize(words.words - words.words.mean(0), dim=-1)
    is_cut = torch.arange(sum(args.batch), device=device) >= args.batch[0]
    begin, sums, n, done, next_mark = time.time(), torch.zeros(6, device=device), 0, False, 0.4
    while not done:
        t, done = over(args.seconds, begin, device)
        network.both.train()
        x, keep, cls = pictures.batch(*args.batch)
        with torch.no_grad(), torch.autocast(KIND, dtype=torch.bfloat16):
            opinion = teacher._fc(teacher.head(normalised(x))).float()
        out = model(normalised(x * keep))
        parts = losses(words, (x, keep, cls), opinion, out, is_cut, near)
        steps.take(parts[0], t)
        sums += torch.stack([p.detach() for p in (*parts, out[-1][0])])
        n += 1
        if steps.step % 200 == 0:
            s = (sums / n).tolist()
            run.tell(f"words step {steps.step} {time.time() - begin:.0f}s loss {s[0]:.3f} ce {s[1]:.3f} bce {s[2]:.3f} kd {s[3]:.3f} near {s[4]:.4f} scale {s[5]:.1f}")
            run.note(step=steps.step, seconds=round(time.time() - begin, 1), losses=[round(v, 4) for v in s])
            sums.zero_()
            n = 0
        if t > next_mark:
            next_mark += 0.7
            measured(f"at {t:.2f}")


def write(out, mean):
    """The tower in half precision; the space whole, under its name once all is there: the text tower's training waits for it."""
    saved({k: v for k, v in mean.items() if k.startswith("tower.")}, os.path.join(out, "words.pt"))
    path = os.path.join(out, "space.pt")
    torch.save({k[6:]: v.cpu() for k, v in mean.items() if k.startswith("space.")}, path + ".tmp")
    os.rename(path + ".tmp", path)


def arguments():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True)
    ap.add_argument("--init", help="words.pt of an earlier run; with it the space is that run's and stays")
    ap.add_argument("--space", help="space.pt of that run")
    ap.add_argument("--back", type=float, default=0.0, help="share of the way back from --init to EfficientNet-Lite2 where the run starts")
    ap.add_argument("--lr", type=float, default=4e-4)
    ap.add_argument("--batch", type=int, nargs=3, default=[160, 64, 48], help="photographs, drawn segments, cut-outs of rooms")
    return ap.parse_args()


def main():
    run = Run(arguments())
    torch.manual_seed(50 + run.rank)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.benchmark = True
    words, pictures, held, teacher, network = load(run)
    steps = steps_of(network, run.args.lr)

    def measured(tag):
        if held:
            figures = held.figures(network, steps.mean)
            run.tell(tag, json.dumps(figures))
            run.note(step=steps.step, held=figures)

    if run.args.init:
        measured("start")
    train(run, words, pictures, teacher, network, steps, measured)
    measured("end")
    if run.rank == 0:
        write(run.args.out, steps.mean)
    run.tell("words trained", steps.step)
    dist.barrier()
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
