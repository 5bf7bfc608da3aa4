"""Trains the image tower on real things under their outlines; the text tower and the canon stay as they are.

    python train_real.py --pack PACK --salient FOLDER --image ../../embedded/image_tower.onnx --out OUT --seconds S

It starts from the bundle's own image tower (batch norm is put back, so that it can be trained), a share --back
of the way to EfficientNet-Lite2. Pictures: things with drawn outlines; class-labelled photographs under the
outline that a salient-object network finds in them, under a random blob, or whole; shapes of things alone; photographs without
labels, for the teacher's opinion. Outlines are made ragged, coarse, and partly hidden; the rest is black,
or dimmed with what lies around; pictures are blurred as small things are. The losses are those of
train_words.py. Pack: pack_real.py, salient.py.
"""
import argparse
import io
import json
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import onnx
import torch
import torch.nn as nn
import torch.nn.functional as F
from onnx import numpy_helper
from PIL import Image

from colours import dominant_colour
from lite import Lite2
from salient import Salient
from words_model import SIDE, ImageTower

KIND = "cuda" if torch.cuda.is_available() else "cpu"
DRAWN, PHOTO, THING, CONTEXT = 352, 176, 144, 0.35
DIM = 0.35  # brightness that is left outside an outline, where it is not black
UNKNOWN = -1
POOL = ThreadPoolExecutor(min(32, os.cpu_count() * 2))


def decode(z, blob="blob", at="offsets", mode="RGB"):
    data, off = z[blob].tobytes(), z[at]
    return list(POOL.map(lambda i: np.asarray(Image.open(io.BytesIO(data[off[i] : off[i + 1]])).convert(mode)), range(len(off) - 1)))


def letterbox(a, size):
    """A picture [h,w,c] in the middle of a black square."""
    k = size / max(a.shape[:2])
    w, h = max(1, round(a.shape[1] * k)), max(1, round(a.shape[0] * k))
    small = np.asarray(Image.fromarray(a).resize((w, h), Image.BICUBIC))
    out = np.zeros((size, size, a.shape[2]), np.uint8)
    y, x = (size - h) // 2, (size - w) // 2
    out[y : y + h, x : x + w] = small
    return out


def window(photo, mask, box, size, context):
    """What lies around `box` (x0, y0, x1, y1), as a square [size,size,4]: colour and mask; black beyond the photo."""
    x0, y0, x1, y1 = box
    side = max(x1 - x0, y1 - y0) * (1 + 2 * context)
    cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
    at = (cx - side / 2, cy - side / 2, cx + side / 2, cy + side / 2)
    # A picture much larger than wanted is made smaller first: the transform does not average.
    k = max(1, int(side / size + 0.5))
    img, m = Image.fromarray(photo), Image.fromarray(mask.astype(np.uint8) * 255)
    if k > 1:
        img, m = img.reduce(k), m.reduce(k)
        at = tuple(v / k for v in at)
    data = ((size, size), Image.EXTENT, at)
    return np.concatenate([np.asarray(img.transform(*data, Image.BILINEAR)), np.asarray(m.transform(*data, Image.BILINEAR))[..., None]], -1)


def drawn(path):
    """Windows [K,DRAWN,DRAWN,4] around drawn things, class, source."""
    z = np.load(path)
    photos, masks, thing = decode(z), decode(z, "mask", "mask_at", "L"), z["thing"]

    def one(row):
        p, n, c, s = row
        m = masks[p] == n
        ys, xs = np.nonzero(m)
        if len(ys) < 40:
            return None
        return window(photos[p], m, (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1), DRAWN, CONTEXT)

    got = list(POOL.map(one, thing))
    keep = [i for i, g in enumerate(got) if g is not None]
    return torch.from_numpy(np.stack([got[i] for i in keep])), torch.from_numpy(thing[keep, 2].astype(np.int64)), torch.from_numpy(thing[keep, 3].astype(np.int64))


@torch.no_grad()
def outlines(net, pictures, chunk=48 if KIND == "cuda" else 2):
    """Salient masks of [N,R,R,3] u8 pictures, u8 [N,R,R], and whether each is one: of a sensible size, and sure."""
    out, fine = [], []
    R = pictures.shape[1]
    for x in pictures.split(chunk):
        m = net(F.interpolate(x.to(net.device).permute(0, 3, 1, 2).float() / 255, (320, 320), mode="bilinear"))
        area, sure = (m > 0.5).float().mean((1, 2)), (m > 0.85).float().sum((1, 2)) / (m > 0.15).float().sum((1, 2)).clamp(min=1)
        fine.append((area > 0.05) & (area < 0.8) & (sure > 0.6))
        out.append((F.interpolate(m[:, None], (R, R), mode="bilinear")[:, 0] * 255).byte())
    return torch.cat(out), torch.cat(fine)


def folded(path):
    """Weights of the exported image tower, int8 with scales made whole again, batch norm inside."""
    graph = onnx.load(path).graph
    raw = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
    out = {k: torch.from_numpy(v.copy()) for k, v in raw.items() if v.dtype == np.float32 and not k.endswith("_s")}
    for n in graph.node:
        if n.op_type == "DequantizeLinear":
            axis = onnx.helper.get_node_attr_value(n, "axis")
            q, s = raw[n.input[0]].astype(np.float32), raw[n.input[1]]
            shape = [1] * q.ndim
            shape[axis] = -1
            out[n.output[0]] = torch.from_numpy(q * s.reshape(shape))
    return out


def pairs(body):
    """(name, convolution, batch norm behind it) of a Lite2."""
    for name, m in body.named_modules():
        for conv, bn in [("_conv_stem", "_bn0"), ("_conv_head", "_bn1"), ("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2")]:
            if hasattr(m, conv) and hasattr(m, bn):
                yield (name + "." if name else "") + conv, getattr(m, conv), getattr(m, bn)


@torch.no_grad()
def unfold(tower, state, lite2, back, pictures):
    """Puts folded weights into a tower with batch norm: its statistics are measured on `pictures`, and its scale and
    shift undo them, so that the network computes what it did."""
    theirs = {n: (c, b) for n, c, b in pairs(lite2)}
    hooks = []
    for name, conv, bn in pairs(tower.body):
        c, b = theirs[name]
        k = b.weight / torch.sqrt(b.running_var + b.eps)
        w, bias = state[f"body.{name}.weight"], state[f"body.{name}.bias"]
        w = w + back * ((c.weight * k[:, None, None, None]).cpu() - w)
        bias = bias + back * ((b.bias - b.running_mean * k).cpu() - bias)
        conv.weight.copy_(w)

        def measure(bn, inputs, bias=bias):
            x = inputs[0].float()
            mean, var = x.mean((0, 2, 3)), x.var((0, 2, 3), unbiased=False)
            bn.running_mean.copy_(mean)
            bn.running_var.copy_(var)
            bn.weight.copy_(torch.sqrt(var + bn.eps))
            bn.bias.copy_(mean + bias.to(mean.device))

        hooks.append(bn.register_forward_pre_hook(measure))
    tower.out.weight.copy_(state["out.weight"])
    tower.out.bias.copy_(state["out.bias"])
    tower.eval()
    out = tower(pictures)
    for h in hooks:
        h.remove()
    return out


def lite2_of(path):
    z = np.load(path)
    state = {}
    for k in z.files:
        if k.endswith(".q"):
            state[k[:-2]] = torch.from_numpy(z[k].astype(np.float32) * z[k[:-2] + ".s"])
        elif not k.endswith(".s"):
            state[k] = torch.from_numpy(z[k].astype(np.float32))
    net = Lite2()
    net.load_state_dict(state, strict=False)
    return net


class Pictures:
    """Batches of cuts, made on the device: what the tower sees, what the teacher sees, class, mask, is it a cut."""

    def __init__(self, pack, net, device, seed):
        at = lambda n: os.path.join(pack, n)
        self.device = device
        self.gen = torch.Generator(device=device).manual_seed(seed)
        self.drawn, self.drawn_class, source = (t.to(device) for t in drawn(at("drawn.npz")))
        named = self.drawn_class >= 0
        count = torch.bincount(self.drawn_class.clamp(min=0), minlength=1).float()
        self.drawn_weight = torch.where(named, count[self.drawn_class.clamp(min=0)] ** -0.55, torch.zeros(1, device=device))
        z = np.load(at("photos.npz"))
        pics = np.stack(list(POOL.map(lambda a: letterbox(a, PHOTO), decode(z))))
        self.photos = torch.from_numpy(pics).to(device)
        self.photo_class = torch.from_numpy(z["label"].astype(np.int64)).to(device)
        self.photo_weight = torch.tensor([1.0, 1.6, 4.0, 4.0], device=device)[torch.from_numpy(z["source"].astype(np.int64)).to(device)]
        mask, self.photo_cut = outlines(net, self.photos)
        self.photos = torch.cat([self.photos, mask[..., None]], -1)
        z = np.load(at("things.npz"))
        words = np.load(at("words.npz"))
        of = {str(n): int(c) for n, c in zip(words["thing_names"], words["things"])}
        pics = np.stack(list(POOL.map(lambda a: letterbox(a, THING), decode(z, mode="RGBA"))))
        self.shapes, self.shape_class = torch.from_numpy(pics).to(device), torch.tensor([of[str(z["names"][n])] for n in z["name"]], device=device)
        self.shape_weight = torch.bincount(self.shape_class)[self.shape_class].float() ** -0.5
        z = np.load(at("wild.npz"))
        wild, found = decode(z), z["found"]
        rng, boxes = np.random.default_rng(seed), []
        for p, c, score, *box in found:
            # The detector looked at the stored photograph; ours may be smaller.
            boxes.append((int(p), int(c) if score > 0.55 else UNKNOWN, box))
        for p, a in enumerate(wild):
            for _ in range(5):
                side = rng.uniform(0.2, 0.7) * min(a.shape[:2])
                x, y = rng.uniform(0, a.shape[1] - side), rng.uniform(0, a.shape[0] - side)
                boxes.append((p, UNKNOWN, (x, y, x + side, y + side)))
        none = [np.ones(a.shape[:2], bool) for a in wild]
        self.wild = torch.from_numpy(np.stack(list(POOL.map(lambda b: window(wild[b[0]], none[b[0]], b[2], 208, 0.12)[..., :3], boxes)))).to(device)
        self.wild_class = torch.tensor([b[1] for b in boxes], device=device)
        mask, self.wild_cut = outlines(net, self.wild)
        self.wild = torch.cat([self.wild, mask[..., None]], -1)
        print("drawn", len(self.drawn), "photographs", len(self.photos), "cut", int(self.photo_cut.sum()), "shapes", len(self.shapes),
              "wild", len(self.wild), "cut", int(self.wild_cut.sum()), "named", int((self.wild_class >= 0).sum()), flush=True)

    def u(self, *s):
        return torch.rand(*s, device=self.device, generator=self.gen)

    def pick(self, weight, n):
        return torch.multinomial(weight, n, True, generator=self.gen)

    def blob(self, B, S):
        g = torch.linspace(-1, 1, S, device=self.device)
        x, y = g[None, None], g[None, :, None]
        cx, cy = ((self.u(B, 1, 1) - 0.5) * 0.5 for _ in range(2))
        rx, ry = (0.35 + self.u(B, 1, 1) * 0.6 for _ in range(2))
        noise = F.interpolate(torch.randn(B, 1, 6, 6, device=self.device, generator=self.gen), (S, S), mode="bicubic")[:, 0] * 0.22
        p = 2 + self.u(B, 1, 1) * 3
        return ((((x - cx) / rx).abs() ** p + ((y - cy) / ry).abs() ** p + noise) < 1).float()[:, None]

    def spoil(self, mask):
        """Masks [B,1,R,R] as a network draws them: ragged, coarse, a part missing, at times too much."""
        B, _, R, _ = mask.shape
        u = lambda: self.u(B, 1, 1, 1)
        k = R // 32 * 2 + 1
        soft = F.avg_pool2d(mask, k, 1, k // 2, count_include_pad=False)
        out = torch.where(u() < 0.6, (soft > 0.15 + u() * 0.7).float(), (mask > 0.5).float())
        grid = R // int(torch.randint(4, 13, (1,), device=self.device, generator=self.gen))
        rough = F.interpolate((F.interpolate(out, (grid, grid), mode="area") > 0.5).float(), (R, R), mode="nearest")
        out = torch.where(u() < 0.35, rough, out)
        # A part missing: what lies beyond a line, or under something round.
        g = torch.linspace(-1, 1, R, device=self.device)
        a, t = u() * 2 * math.pi, (u() - 0.35) * 0.9
        line = (g.view(1, 1, 1, R) * a.cos() + g.view(1, 1, R, 1) * a.sin() < 0.7 * t + 0.2).float()
        cx, cy, r = (u() - 0.5) * 1.6, (u() - 0.5) * 1.6, 0.1 + u() * 0.4
        hole = ((g.view(1, 1, 1, R) - cx) ** 2 + (g.view(1, 1, R, 1) - cy) ** 2 > r * r).float()
        which = u()
        part = torch.where(which < 0.22, line, torch.where(which < 0.42, hole, torch.ones_like(line)))
        more = torch.where(u() < 0.08, F.max_pool2d(out, k, 1, k // 2), out)
        less = more * part
        area = lambda m: m.sum((1, 2, 3), keepdim=True)
        whole = area((mask > 0.5).float())
        less = torch.where(area(less) > 0.35 * whole, less, more)
        less = torch.where(area(less) > 0.3 * whole, less, (mask > 0.5).float())
        return torch.where(area(less) > 8, less, torch.ones_like(less))

    def cut(self, bank, mask, dim):
        """Windows [B,3,R,R] 0..1 and masks [B,1,R,R] -> [B,3,S,S], [B,1,S,S]: the box of the mask, as the server cuts it.

        `dim` [B]: whether what lies around is to be seen, and so a margin is wanted.
        """
        B, R = len(bank), bank.shape[-1]
        m = mask[:, 0] > 0.5
        ends = []
        for axis in (1, 2):
            line = m.any(axis).float()
            first = line.argmax(1).float()
            last = R - line.flip(1).argmax(1).float()
            ends.append(((first + last) / R - 1, (last - first) / R * 2))
        (cx, w), (cy, h) = ends
        side = torch.maximum(w, h)
        margin = torch.where(dim, 0.1 + self.u(B) * 0.2, (self.u(B) - 0.3).clamp(min=0) * 0.1)
        k = side / 2 * (1 + 2 * margin) * torch.exp((self.u(B) - 0.5) * 0.06)
        a = torch.where(self.u(B) < 0.6, (self.u(B) - 0.5) * 0.5, torch.zeros(B, device=self.device))
        flip = torch.where(self.u(B) < 0.5, -1.0, 1.0)
        stretch = torch.exp((self.u(B) - 0.5) * 0.24)
        theta = torch.stack([torch.stack([k * flip * stretch * a.cos(), -k * a.sin(), cx], -1), torch.stack([k * flip * a.sin(), k / stretch * a.cos(), cy], -1)], 1)
        both = F.grid_sample(torch.cat([bank, mask], 1), F.affine_grid(theta, (B, 1, SIDE, SIDE), align_corners=False), align_corners=False)
        return both[:, :3], (both[:, 3:] > 0.5).float()

    def soften(self, x):
        """Some pictures as if they were small, or far, or out of focus."""
        order = torch.randperm(len(x), device=self.device, generator=self.gen)
        out = x.clone()
        share = order[: int(0.45 * len(x))].chunk(6)
        for rows in share:
            n = int(24 * math.exp(float(torch.rand(1, device=self.device, generator=self.gen)) * 1.7))
            small = F.interpolate(x[rows], (n, n), mode="bilinear", antialias=True)
            out[rows] = F.interpolate(small, (SIDE, SIDE), mode="bilinear").clamp(0, 1)
        noise = self.u(len(x), 1, 1, 1) * 0.05 * (self.u(len(x), 1, 1, 1) < 0.4)
        grain = F.interpolate(torch.randn(len(x), 3, SIDE // 2, SIDE // 2, device=self.device, generator=self.gen), (SIDE, SIDE), mode="bilinear")
        return (out + grain * noise).clamp(0, 1)

    def recolour(self, x):
        B = len(x)
        gain = torch.exp((self.u(B, 3, 1, 1) - 0.5) * 0.25 + (self.u(B, 1, 1, 1) - 0.5) * 0.9)
        c = torch.exp((self.u(B, 1, 1, 1) - 0.5) * 0.5)
        gray = x.mean(1, keepdim=True)
        x = gray + (x - gray) * (0.55 + self.u(B, 1, 1, 1) * 0.7)
        return (((x * gain) - 0.4) * c + 0.4).clamp(0, 1)

    @torch.no_grad()
    def batch(self, n):
        parts = []

        def add(bank, cls, pick, mask_of, cut_share, paste_share):
            x = bank[pick].permute(0, 3, 1, 2).float() / 255
            B, R = len(x), x.shape[-1]
            mask = mask_of(x, pick)
            dim = self.u(B) < 0.45
            rgb, m = self.cut(x[:, :3], self.spoil(mask), dim)
            # What was whole stays so: no outline is made of a photograph that shows none.
            parts.append((rgb, m, cls[pick], dim, self.u(B) < paste_share))

        add(self.drawn, self.drawn_class, self.pick(self.drawn_weight, n[0]), lambda x, p: x[:, 3:], 1, 0.1)

        def of_photo(x, p):
            B, R = len(x), x.shape[-1]
            r, ok = self.u(B, 1, 1, 1), self.photo_cut[p].view(-1, 1, 1, 1)
            inside = (x[:, :3].amax(1, keepdim=True) > 0).float()
            other = torch.where(self.u(B, 1, 1, 1) < 0.5, inside, self.blob(B, R) * inside)
            return torch.where(ok & (r < 0.72), x[:, 3:], other)

        add(self.photos, self.photo_class, self.pick(self.photo_weight, n[1]), of_photo, 1, 0.3)
        add(self.shapes, self.shape_class, self.pick(self.shape_weight, n[2]), lambda x, p: x[:, 3:], 1, 0.6)

        def of_wild(x, p):
            B, R = len(x), x.shape[-1]
            ok = self.wild_cut[p].view(-1, 1, 1, 1) & (self.u(B, 1, 1, 1) < 0.75)
            return torch.where(ok, x[:, 3:], torch.where(self.u(B, 1, 1, 1) < 0.5, self.blob(B, R), torch.ones_like(x[:, 3:])))

        add(self.wild, self.wild_class, torch.randint(0, len(self.wild), (n[3],), device=self.device, generator=self.gen), of_wild, 1, 0.0)
        x, m, cls, dim, paste = (torch.cat(p) for p in zip(*parts))
        # Shapes have nothing around them; others may stand elsewhere: before a window of another photograph.
        other = self.drawn[torch.randint(0, len(self.drawn), (len(x),), device=self.device, generator=self.gen)]
        other = F.interpolate(other[..., :3].permute(0, 3, 1, 2).float() / 255, (SIDE, SIDE), mode="bilinear")
        soft = F.avg_pool2d(m, 3, 1, 1)
        seen = torch.where(paste.view(-1, 1, 1, 1), other * (1 - soft) + x * soft, x)
        seen = self.recolour(self.soften(seen))
        share = torch.where(dim, DIM + (self.u(len(x)) - 0.5) * 0.2, torch.zeros(1, device=self.device)).view(-1, 1, 1, 1)
        return seen * (m + (1 - m) * share), x, cls, m


def normalised(x):
    return ((x * 255 - 127) / 128).contiguous(memory_format=torch.channels_last)


def exact(bank, dim, margin):
    """The cuts of windows [K,R,R,4], as the server makes them."""
    out = []
    for x in bank.split(64):
        x = x.permute(0, 3, 1, 2).float() / 255
        m = (x[:, 3:] > 0.5).float()
        B, R = len(x), x.shape[-1]
        ends = []
        for axis in (1, 2):
            line = (m[:, 0] > 0.5).any(axis).float()
            first, last = line.argmax(1).float(), R - line.flip(1).argmax(1).float()
            ends.append(((first + last) / R - 1, (last - first) / R * 2))
        (cx, w), (cy, h) = ends
        k = torch.maximum(w, h) / 2 * (1 + 2 * margin)
        zero = torch.zeros_like(k)
        theta = torch.stack([torch.stack([k, zero, cx], -1), torch.stack([zero, k, cy], -1)], 1)
        both = F.grid_sample(torch.cat([x[:, :3], m], 1), F.affine_grid(theta, (B, 1, SIDE, SIDE), align_corners=False), align_corners=False)
        inside = (both[:, 3:] > 0.5).float()
        out.append(both[:, :3] * (inside + (1 - inside) * dim))
    return torch.cat(out)


def main():
    ap = argparse.ArgumentParser()
    for name in ["pack", "salient", "image", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--seconds", type=float, required=True)
    ap.add_argument("--back", type=float, default=0.15)
    ap.add_argument("--lr", type=float, default=3e-4)
    ap.add_argument("--batch", type=int, nargs=4, default=[136, 120, 32, 40], help="drawn, photographs, shapes, without labels")
    ap.add_argument("--seed", type=int, default=70)
    args = ap.parse_args()
    device = torch.device(KIND)
    torch.manual_seed(args.seed)
    torch.backends.cuda.matmul.allow_tf32 = True
    start = time.time()
    os.makedirs(args.out, exist_ok=True)
    at = lambda n: os.path.join(args.pack, n)
    z = np.load(at("words.npz"))
    get = lambda n: torch.from_numpy(z[n]).to(device)
    tw, canon, truth_of = F.normalize(get("embed").float(), dim=-1), F.normalize(get("canon").float(), dim=-1), get("truth")
    own, colour_at, thousand_class, everyday = get("own").long(), get("colours").long(), get("thousand").long(), get("everyday").long()
    own_words, own_of = torch.unique(own, return_inverse=True)
    thousand = own[thousand_class]
    net = Salient(args.salient, device, torch.float16 if KIND == "cuda" else torch.float32)
    pictures = Pictures(args.pack, net, device, args.seed + 1)
    del net
    teacher = lite2_of(at("lite2.npz")).to(device).eval().requires_grad_(False).to(memory_format=torch.channels_last)
    tower = ImageTower().to(device)
    sample, _, _, _ = pictures.batch([k * 3 for k in args.batch])
    unfold(tower, folded(args.image), teacher, args.back, normalised(sample))
    tower.to(memory_format=torch.channels_last)
    scale = nn.Parameter(torch.tensor([math.log(36.0), math.log(36.0)], device=device))
    fc = teacher._fc
    held, held_class, held_source = (t.to(device) for t in drawn(at("drawn_held.npz")))
    keep = held_class >= 0
    held, held_class, held_source = held[keep], held_class[keep], held_source[keep]
    zh = np.load(at("held.npz"))
    whole = torch.from_numpy(np.stack([letterbox(a, SIDE) for a in decode(zh)])).to(device).permute(0, 3, 1, 2)
    whole_class = torch.from_numpy(zh["label"].astype(np.int64)).to(device)
    log = open(os.path.join(args.out, "real.jsonl"), "w")
    begin, step = time.time(), 0

    @torch.no_grad()
    def embed(model, x):
        with torch.autocast(KIND, dtype=torch.bfloat16):
            return torch.cat([model(normalised(p)) for p in x.split(256)]).float()

    @torch.no_grad()
    def evaluate(model, tag):
        model.eval()
        torch.backends.cudnn.benchmark = False  # its sizes are used once
        out = {}
        for name, dim, margin in (("black", 0.0, 0.0), ("dimmed", DIM, 0.2)):
            f = embed(model, exact(held, dim, margin))
            floor = (f @ canon.T).amax(1)
            mine = (f * tw[own[held_class]]).sum(1)
            t, s = truth_of[held_class][:, everyday], f @ tw[everyday].T
            absent = ((s >= floor[:, None]) & (t == 0)).sum() / (t == 0).sum()
            best = s.argmax(1)
            right = (t.gather(1, best[:, None])[:, 0] != 0) | (mine >= s.amax(1))
            found = mine >= floor
            by = [round(float(v[held_source == k].float().mean()), 3) for v in (found, right) for k in range(5)]
            out[name] = {"found": round(float(found.float().mean()), 3), "right": round(float(right.float().mean()), 3), "absent": round(float(absent), 4), "by set": by}
        f = embed(model, whole.float() / 255)
        top = (f @ tw[own_words].T).argmax(1) == own_of[whole_class]
        out["whole photographs"] = {"top1": round(float(top.float().mean()), 3), "found": round(float(((f * tw[own[whole_class]]).sum(1) >= (f @ canon.T).amax(1)).float().mean()), 3)}
        print(tag, json.dumps(out), flush=True)
        log.write(json.dumps({"step": step, "tag": tag, **out}) + "\n")
        log.flush()

    first = ImageTower().to(device)
    with torch.no_grad():
        unfold(first, folded(args.image), teacher, 0.0, normalised(sample))
    evaluate(first.to(memory_format=torch.channels_last), "shipped")
    evaluate(tower, "start")
    del first
    ema = {k: v.detach().clone() for k, v in tower.state_dict().items()}
    live = [v for v in tower.state_dict().values() if v.is_floating_point()]
    kept = [ema[k] for k, v in tower.state_dict().items() if v.is_floating_point()]
    mean_tower = ImageTower().to(device).to(memory_format=torch.channels_last)
    heads = list(tower.out.parameters()) + [scale]
    opt = torch.optim.AdamW([{"params": list(tower.body.parameters()), "k": 0.5, "weight_decay": 0.03}, {"params": heads, "k": 2.0, "weight_decay": 0.0}], lr=args.lr, betas=(0.9, 0.99))

    def save(name):
        torch.save({"tower." + k: v.half().cpu() for k, v in ema.items()}, os.path.join(args.out, name + ".tmp"))
        os.rename(os.path.join(args.out, name + ".tmp"), os.path.join(args.out, name))

    def averaged():
        mean_tower.load_state_dict(ema)
        return mean_tower

    print("ready", round(time.time() - start, 1), "classes", len(own), "words", len(tw), flush=True)
    begin, sums, n, marks = time.time(), torch.zeros(6, device=device), 0, [0.15, 0.4, 0.65, 0.85]
    while True:
        t = (time.time() - begin) / args.seconds
        if t >= 1:
            break
        for group in opt.param_groups:
            group["lr"] = args.lr * group["k"] * min(1, (step + 1) / 150) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * t)))
        tower.train()
        torch.backends.cudnn.benchmark = True
        x, clean, cls, mask = pictures.batch(args.batch)
        with torch.no_grad(), torch.autocast(KIND, dtype=torch.bfloat16):
            opinion = fc(teacher.head(normalised(clean))).float()
        with torch.autocast(KIND, dtype=torch.bfloat16):
            features = tower.body.head(normalised(x))
            f = tower.embed(features)
            # Features as EfficientNet-Lite2 would have of each of its thousand classes (train_words.py).
            k = torch.randint(0, 1000, (256,), device=device)
            base = features.detach()[torch.randint(0, len(features), (256,), device=device)].float()
            push = 6 + 8 * torch.rand(256, 1, device=device)
            g = tower.embed((0.6 * base + push * fc.weight[k] / fc.weight[k].square().sum(1, keepdim=True)).clamp(min=0))
            said = fc(features).float()
        sc = scale.exp()
        named = (cls >= 0).float()
        c = cls.clamp(min=0)
        cos = f @ tw.T
        want = own_of[c]
        truth = truth_of[c].clone()
        ce_logits = sc[0] * cos[:, own_words]
        other = (truth[:, own_words] != 0) & ~F.one_hot(want, len(own_words)).bool()
        ce = (F.cross_entropy(ce_logits.masked_fill(other, -1e4), want, reduction="none") * named).sum() / named.sum()
        margin = (cos - (f @ canon.T).amax(1, keepdim=True)) * sc[1].clamp(max=40)
        is_cut = torch.arange(len(cls), device=device) < args.batch[0]
        shapes = torch.arange(len(cls), device=device)
        is_cut = is_cut | ((shapes >= sum(args.batch[:2])) & (shapes < sum(args.batch[:3])))
        truth[:, colour_at] = torch.where(is_cut[:, None], dominant_colour(x, mask), -1).to(truth.dtype)
        pos, neg = (truth == 1).float(), (truth == 0).float()
        itself = F.one_hot(own_words[want], pos.shape[1]) * pos
        rest = pos - itself
        p_loss = (F.softplus(-margin) * (itself + rest / rest.sum(1, keepdim=True).clamp(min=1))).sum(1) / 2
        near = neg * (margin.detach().sigmoid() + 0.01)
        n_loss = (F.softplus(margin) * near).sum(1) / near.sum(1).clamp(min=1e-3)
        bce = ((2 * p_loss + 1.5 * n_loss) * named).sum() / named.sum()
        kd = F.kl_div((sc[0] * cos[:, thousand]).log_softmax(-1), (opinion / 1.5).softmax(-1), reduction="none").sum(-1)
        kd = (kd * torch.where(named > 0, 0.4, 1.0)).mean()
        kd = kd + 0.5 * F.kl_div((said / 1.5).log_softmax(-1), (opinion / 1.5).softmax(-1), reduction="none").sum(-1).mean()
        made_cos = g @ tw[thousand].T
        made_margin = made_cos.gather(1, k[:, None])[:, 0] - (g @ canon.T).amax(1)
        made = F.cross_entropy(sc[0] * made_cos, k) + F.softplus(-made_margin * sc[1].clamp(max=40)).mean()
        loss = ce + bce + 0.6 * kd + 0.3 * made
        opt.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(tower.parameters(), 2.0)
        if torch.isfinite(norm):
            opt.step()
        with torch.no_grad():
            torch._foreach_lerp_(kept, live, 1 - min(0.998, (step + 1) / (step + 10)))
        sums += torch.stack([loss.detach(), ce.detach(), bce.detach(), kd.detach(), made.detach(), sc[0].detach()])
        n, step = n + 1, step + 1
        if step % 50 == 0:
            s = (sums / n).tolist()
            print(f"step {step} {time.time() - begin:.0f}s loss {s[0]:.3f} ce {s[1]:.3f} bce {s[2]:.3f} kd {s[3]:.3f} made {s[4]:.3f} scale {s[5]:.1f}", flush=True)
            log.write(json.dumps({"step": step, "seconds": round(time.time() - begin, 1), "losses": [round(v, 4) for v in s]}) + "\n")
            sums.zero_()
            n = 0
        if marks and t > marks[0]:
            marks.pop(0)
            evaluate(averaged(), f"at {t:.2f}")
            save("real.pt")
    evaluate(averaged(), "end")
    save("real.pt")
    print("trained", step, flush=True)


if __name__ == "__main__":
    main()
