"""Banks of pictures for `train_open.py`, what the teachers say of each, and batches of cuts of them."""
import math
import os

import numpy as np
import torch
import torch.nn.functional as F

from augment import Augment
from pictures import POOL, decode, exact, letterbox, windows
from towers import normalised
from words_model import SIDE

KIND = "cuda" if torch.cuda.is_available() else "cpu"
DRAWN, PHOTO, THING, CONTEXT = 352, 176, 144, 0.35  # sides of the windows; what lies around a drawn thing
DIM = 0.35  # brightness that is left outside an outline, where it is not black
UNKNOWN = -1
SOURCES = [1.0, 1.6, 7.0, 5.0]  # how often a photograph of each labelled set is seen
TOP = 16  # likeliest names of EfficientNet-Lite2 that are kept
# What the tower that training begins with is shown: brightness outside the outline, margin, weight.
VIEWS = [(0.0, 0.0, 1.0), (1.0, 0.08, 0.6), (1.0, 0.3, 0.4)]


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


class Cuts(Augment):
    """Batches of cuts of four banks, with what the teachers said of each."""

    def __init__(self, pack, salient, net_masks, prepared, device, seed, limit):
        super().__init__(device, seed)
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
        """As Augment.spoil; a fifth of the masks also takes in a piece of what is beside the thing."""
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
