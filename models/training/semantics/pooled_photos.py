"""Batches for `train_pooled.py`, made on the device: whole photos with several masks each, and cuts of the same things.

A *canvas* is what the tower sees as a whole photo: a turned, scaled, recoloured photograph with cut-outs pasted into it, or
a mosaic of class-labelled photographs. Its things keep an index picture, so that each has a mask however it was
moved. What is not labelled is never a negative.
"""
import math
import os

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from pictures import POOL, cornered, decoded

TRAIN, HELD, JUDGE = 0, 1, 2  # what a packed photograph is for
CUTOUTS = ("ikea_cutouts", "objects_photos")
STORE = 448  # photographs are kept as squares of this side
CUTOUT, TILE = 224, 128
PASTES, CANDIDATES = 3, 12  # a canvas: cut-outs at most, things that are tried
# Share of the canvases that show photographs of each set; mosaics have their own share.
SHARES = {
    "coco_instances": 0.17, "coco_panoptic_200": 0.13, "furniture_seg": 0.10, "household_polygons": 0.05, "pets_trimaps": 0.03, "ade20k_samples": 0.003,
    "rooms_polygons": 0.03, "pantry_polygons": 0.10, "tools_polygons": 0.05, "ikea_cutouts": 0.02, "objects_photos": 0.03, "boxes_rooms": 0.04,
    "boxes_doors": 0.03, "boxes_groceries": 0.03, "boxes_misc": 0.02, "human_seg": 0.02, "bsds500": 0.06, "coco_unlabelled": 0.10,
}
SHAPES = [(448, 448), (416, 576), (576, 416), (576, 576)]  # few: the library chooses its algorithms for each
FAR = {"share": 0.3, "sizes": 3, "least": 0.23, "span": 1.3}  # of the pictures, how many are as if seen from afar
AREA = 40 * 448 * 448  # pixels of the canvases of one step
MOSAICS, PASTED = 0.2, 0.5  # shares of canvases: mosaics; others with something pasted into them


def boxes_of(label, rows):
    """[(row, x0, y0, x1, y1, area)] of the things of an index picture that are large enough."""
    out = []
    for r, n in rows:
        m = label == n
        ys, xs = np.nonzero(m.any(1))[0], np.nonzero(m.any(0))[0]
        area = int(m.sum())
        if area >= 0.001 * label.size and max(np.ptp(ys), np.ptp(xs)) >= 14:
            out.append((r, xs[0], ys[0], xs[-1] + 1, ys[-1] + 1, area))
    return out


class Photos:
    """`pics` u8 [N,S,S,3], `labels` u8 [N,S,S], `size` [N,2]; a row of `things` is one mask: photo, index, class (-1: no name),
    boxes or outline, x0, y0, x1, y1, area, set. Sets of `without` are left out."""

    def __init__(self, pack, withheld, device, limit=0, extra=None, without=()):
        pics, labels, sizes, things, sets = [], [], [], [], []
        self.names = [s for s in SHARES if s not in without and os.path.exists(os.path.join(pack, f"photos_{s}.npz"))]
        for s, name in enumerate(self.names):
            with np.load(os.path.join(pack, f"photos_{name}.npz")) as z:
                z = {k: z[k] for k in z.files}
            keep = np.nonzero(z["part"] == TRAIN)[0]
            keep = keep[:: max(1, len(keep) // limit)] if limit else keep
            of = {p: [] for p in keep}
            for r, (p, n, _, _) in enumerate(z["thing"]):
                if p in of:
                    of[p].append((r, n))

            def one(p):
                pic, h, w = cornered(decoded(z["blob"], z["offsets"], p), STORE)
                drawn = decoded(z["mask"], z["mask_at"], p, "L")
                label, _, _ = cornered(drawn, STORE, Image.NEAREST)
                rows = of[p]
                if not rows and extra is not None and f"{name}:{z['key'][p]}" in extra:
                    label, _, _ = cornered(extra[f"{name}:{z['key'][p]}"], STORE, Image.NEAREST)
                    return pic, label, (h, w), [(-1, n, *b[1:]) for n in np.unique(label[label > 0]) for b in boxes_of(label[:h, :w], [(0, n)])]
                index = {r: n for r, n in rows}
                return pic, label, (h, w), [(b[0], index[b[0]], *b[1:]) for b in boxes_of(label[:h, :w], rows)]

            for p, (pic, label, hw, found) in zip(keep, POOL.map(one, keep)):
                at = len(pics)
                pics.append(pic), labels.append(label), sizes.append(hw), sets.append(s)
                for r, n, x0, y0, x1, y1, area in found:
                    c, loose = (-1, 0) if r < 0 else z["thing"][r, 2:]
                    if c < 0 or not withheld[c]:
                        things.append((at, n, c, loose, x0, y0, x1, y1, area, s))
        self.pics, self.labels = torch.from_numpy(np.stack(pics)).to(device), torch.from_numpy(np.stack(labels)).to(device)
        self.size, self.sets = torch.tensor(sizes, device=device).float(), torch.tensor(sets, device=device)
        self.things = torch.tensor(np.array(things), device=device).long()
        # Things of one photo, as a padded table.
        count = torch.bincount(self.things[:, 0], minlength=len(pics))
        first = count.cumsum(0) - count
        width = int(count.max())
        self.table = torch.full((len(pics), width), -1, device=device)
        self.table[self.things[:, 0], torch.arange(len(self.things), device=device) - first[self.things[:, 0]]] = torch.arange(len(self.things), device=device)
        # How often a photo is shown: its set's share, and more where its names are rare.
        cls = self.things[:, 2]
        freq = torch.bincount(cls.clamp(min=0)).float()
        self.rare = torch.where(cls >= 0, freq[cls.clamp(min=0)] ** -0.5, torch.full((len(cls),), 0.05, device=device))
        each = torch.zeros(len(pics), device=device).index_add_(0, self.things[:, 0], self.rare) / count.clamp(min=1) ** 0.5
        each = each.sqrt() * (count > 0)
        total = torch.zeros(len(self.names), device=device).index_add_(0, self.sets, each)
        share = torch.tensor([SHARES[n] for n in self.names], device=device)
        self.weight = each / total[self.sets].clamp(min=1e-9) * share[self.sets]

    def cutouts(self, size=CUTOUT):
        """Pictures u8 [K,size,size,4], classes and rows of the things that stand alone."""
        which = torch.tensor([n in CUTOUTS for n in self.names], device=self.things.device)[self.things[:, 9]]
        at = torch.nonzero(which & (self.things[:, 2] >= 0))[:, 0]
        rows, out = self.things[at], []
        for p, n, _, _, x0, y0, x1, y1, *_ in rows.tolist():
            both = torch.cat([self.pics[p, y0:y1, x0:x1], ((self.labels[p, y0:y1, x0:x1] == n) * 255).byte()[..., None]], -1).cpu().numpy()
            out.append(torch.from_numpy(cornered(both, size)[0]))
        return torch.stack(out).to(self.pics.device), rows[:, 2], at


def class_labelled(pack, withheld, device, limit=0):
    """Pictures u8 [N,TILE,TILE,3], their height and width, and classes; held-out ones and withheld classes left out."""
    with np.load(os.path.join(pack, "labelled.npz")) as z:
        z = {k: z[k] for k in z.files}
    keep = np.nonzero(~z["held"] & ~withheld[z["label"]])[0]
    keep = keep[:: max(1, len(keep) // limit)] if limit else keep
    got = list(POOL.map(lambda i: cornered(decoded(z["blob"], z["offsets"], i), TILE), keep))
    return (torch.from_numpy(np.stack([g[0] for g in got])).to(device), torch.tensor([g[1:] for g in got], device=device).float(),
            torch.from_numpy(z["label"][keep].astype(np.int64)).to(device))


class Canvases:
    """Makes batches. A batch: canvases [B,3,H,W] 0..1; of K things, sorted by canvas: canvas, masks [K,H,W], cell weights,
    class, kind (0: thing of a photo, 1: pasted, 2: class-labelled photograph) and row (of things, or of photographs)."""

    def __init__(self, photos, tiles, augment, device):
        self.photos, (self.tiles, self.tile_size, self.tile_class) = photos, tiles
        self.paste, self.paste_class, self.paste_thing = photos.cutouts()
        self.a, self.device = augment, device
        self.paste_weight = torch.bincount(self.paste_class)[self.paste_class].float() ** -0.5
        self.tile_weight = torch.bincount(self.tile_class)[self.tile_class].float() ** -0.6

    def view(self, size, H, W):
        """Where canvases H x W look in squares of which [B,2] (height, width) is picture: theta [B,2,3] and scale [B]."""
        B, S, u = len(size), STORE, self.a.u
        h, w = size[:, 0], size[:, 1]
        fit, cover = torch.minimum(H / h, W / w), torch.maximum(H / h, W / w)
        lo, hi = (0.9 * (fit * cover).sqrt()).log(), (1.7 * cover).log()
        s = (lo + (hi - lo) * u(B)).exp()
        a = torch.where(u(B) < 0.5, (u(B) - 0.5) * 0.5, torch.zeros_like(s))
        flip = torch.where(u(B) < 0.5, -1.0, 1.0)
        room = lambda n, N: (torch.rand_like(s) - 0.5) * (n - N / s).abs()  # stays inside, or the picture stays in view
        cx, cy = w / 2 + room(w, W), h / 2 + room(h, H)
        theta = torch.stack([torch.stack([W / s * flip * a.cos() / S, -H / s * a.sin() / S, cx * 2 / S - 1], -1),
                             torch.stack([W / s * flip * a.sin() / S, H / s * a.cos() / S, cy * 2 / S - 1], -1)], 1)
        return theta, s

    def mosaic(self, n):
        """Squares [n,3,S,S] 0..1 of class-labelled photographs side by side, index pictures, classes and rows [n,16]."""
        g = 2 + int(torch.randint(0, 3, (1,)))
        c = math.ceil(STORE / g)
        pick = self.a.pick(self.tile_weight, n * g * g)
        x = self.tiles[pick].permute(0, 3, 1, 2).float() / 255
        h, w = self.tile_size[pick].T
        k = torch.minimum(h, w) * (0.75 + 0.25 * self.a.u(len(pick)))  # side of the square that is looked at
        a = torch.where(self.a.u(len(pick)) < 0.3, (self.a.u(len(pick)) - 0.5) * 0.4, torch.zeros_like(k))
        flip = torch.where(self.a.u(len(pick)) < 0.5, -1.0, 1.0)
        cx, cy = (d / 2 + (self.a.u(len(pick)) - 0.5) * (d - k) for d in (w, h))
        theta = torch.stack([torch.stack([k * flip * a.cos() / TILE, -k * a.sin() / TILE, cx * 2 / TILE - 1], -1),
                             torch.stack([k * flip * a.sin() / TILE, k * a.cos() / TILE, cy * 2 / TILE - 1], -1)], 1)
        t = F.grid_sample(x, F.affine_grid(theta, (len(x), 3, c, c), align_corners=False), padding_mode="reflection", align_corners=False)
        t = t.view(n, g, g, 3, c, c).permute(0, 3, 1, 4, 2, 5).reshape(n, 3, g * c, g * c)[..., :STORE, :STORE]
        index = torch.arange(1, g * g + 1, device=self.device).view(g, g).repeat_interleave(c, 0).repeat_interleave(c, 1)[:STORE, :STORE]
        rows = torch.full((n, 16), -1, device=self.device)
        rows[:, : g * g] = pick.view(n, -1)
        return t, index.expand(n, -1, -1).float(), rows

    def pasted(self, canvas, label, rows):
        """Cut-outs over some canvases: index 256 and up in the index pictures; their rows go into `rows` [B,PASTES]."""
        B, _, H, W = canvas.shape
        u = self.a.u
        on = u(B) < PASTED
        for j in range(PASTES):
            here = on & (u(B) < (1.0, 0.6, 0.4)[j])
            pick = self.a.pick(self.paste_weight, B)
            x = self.paste[pick].permute(0, 3, 1, 2).float() / 255
            side = (math.log(0.12) + (math.log(0.55) - math.log(0.12)) * u(B)).exp() * min(H, W)
            a = torch.where(u(B) < 0.6, (u(B) - 0.5) * 0.9, torch.zeros_like(side))
            flip = torch.where(u(B) < 0.5, -1.0, 1.0)
            # Centres in the canvas, -1..1; canvas -> cut-out is scale W / side about the centre. The picture is in its top left corner.
            cx, cy = (u(B) * 1.8 - 0.9, u(B) * 1.8 - 0.9)
            ax, ay = (x[:, 3].amax(1) > 0.5).float().sum(1) / CUTOUT - 1, (x[:, 3].amax(2) > 0.5).float().sum(1) / CUTOUT - 1
            kx, ky = W / side, H / side
            theta = torch.stack([torch.stack([flip * kx * a.cos(), -ky * a.sin(), ax - flip * kx * a.cos() * cx + ky * a.sin() * cy], -1),
                                 torch.stack([flip * kx * a.sin(), ky * a.cos(), ay - flip * kx * a.sin() * cx - ky * a.cos() * cy], -1)], 1)
            y = F.grid_sample(x, F.affine_grid(theta, (B, 4, H, W), align_corners=False), align_corners=False)
            gain = torch.exp((u(B, 3, 1, 1) - 0.5) * 0.2 + (u(B, 1, 1, 1) - 0.5) * 0.6)
            soft = F.avg_pool2d(y[:, 3:], 3, 1, 1) * here.view(-1, 1, 1, 1)
            canvas = canvas * (1 - soft) + (y[:, :3] * gain).clamp(0, 1) * soft
            label = torch.where((soft[:, 0] > 0.5), 256.0 + j, label)
            rows[:, j] = torch.where(here, pick, -1)
        return canvas, label

    def spoiled(self, masks):
        """Masks [K,H,W] at an eighth of the size, ragged, too small or too large, as a network draws them -> cell weights."""
        m = F.avg_pool2d(masks[:, None].float(), 8)
        K = len(m)
        t = 0.12 + 0.7 * self.a.u(K, 1, 1, 1)
        soft = F.avg_pool2d(m, 3, 1, 1, count_include_pad=False)
        wide = F.avg_pool2d(m, 7, 1, 3, count_include_pad=False)
        which = self.a.u(K, 1, 1, 1)
        made = torch.where(which < 0.5, m, torch.where(which < 0.8, (soft > t).float(), (wide > t).float()))
        made = torch.where(made.sum((2, 3), keepdim=True) > 0.4 * m.sum((2, 3), keepdim=True), made, m)
        return F.avg_pool2d(made, 4)[:, 0]

    @torch.no_grad()
    def batch(self, area=AREA):
        H, W = SHAPES[int(torch.randint(0, len(SHAPES), (1,)))]
        B = max(2, round(area / (H * W)))
        m = max(1, round(B * MOSAICS))
        dev = self.device
        pick = self.a.pick(self.photos.weight, B - m)
        x = self.photos.pics[pick].permute(0, 3, 1, 2).float() / 255
        l = self.photos.labels[pick].float()
        tiles, index, tile_rows = self.mosaic(m)
        x, l = torch.cat([x, tiles]), torch.cat([l, index])
        size = torch.cat([self.photos.size[pick], torch.full((m, 2), float(STORE), device=dev)])
        theta, scale = self.view(size, H, W)
        grid = F.affine_grid(theta, (B, 3, H, W), align_corners=False)
        canvas = F.grid_sample(x, grid, align_corners=False)
        label = F.grid_sample(l[:, None], grid, mode="nearest", align_corners=False)[:, 0]
        paste_rows = torch.full((B, PASTES), -1, device=dev)
        canvas, label = self.pasted(canvas, label, paste_rows)
        # Candidates of each canvas: things drawn by how rare their names are, then tiles, then what was pasted.
        rows = self.photos.table[pick]
        rare = torch.where(rows >= 0, self.photos.rare[rows.clamp(min=0)], torch.full_like(rows, 1e-9, dtype=torch.float))
        n = min(CANDIDATES, rows.shape[1])
        some = rows.gather(1, torch.multinomial(rare, n, False, generator=self.a.gen))
        T = max(n, 16)
        kind, row, idx = (torch.full((B, T + PASTES), v, device=dev) for v in (0, -1, -1))
        row[: B - m, :n] = some
        idx[: B - m, :n] = torch.where(some >= 0, self.photos.things[some.clamp(min=0), 1], -1)
        row[B - m :, :16], kind[B - m :, :16] = tile_rows, 2
        idx[B - m :, :16] = torch.where(tile_rows >= 0, torch.arange(1, 17, device=dev), -1)
        row[:, T:], kind[:, T:] = paste_rows, 1
        idx[:, T:] = torch.where(paste_rows >= 0, torch.arange(256, 256 + PASTES, device=dev), -1)
        of, at = torch.nonzero(idx >= 0, as_tuple=True)
        masks = label[of] == idx[of, at].view(-1, 1, 1)
        seen = masks.flatten(1).sum(1).float()
        kind, row = kind[of, at], row[of, at]
        whole = torch.where(kind == 0, self.photos.things[row.clamp(max=len(self.photos.things) - 1), 8].float() * scale[of] ** 2, seen)
        keep = (seen > 200) & (seen > 0.35 * whole) & (seen < 0.9 * H * W)
        of, masks, kind, row = of[keep], masks[keep], kind[keep], row[keep]
        cls = torch.where(kind == 0, self.photos.things[row.clamp(max=len(self.photos.things) - 1), 2],
                          torch.where(kind == 1, self.paste_class[row.clamp(max=len(self.paste_class) - 1)], self.tile_class[row.clamp(max=len(self.tile_class) - 1)]))
        loose = (kind == 0) & (self.photos.things[row.clamp(max=len(self.photos.things) - 1), 3] > 0) | (kind == 2)
        seen_canvas = self.a.recolour(self.a.soften(canvas, **FAR))
        row = torch.where(kind == 1, self.paste_thing[row.clamp(max=len(self.paste_thing) - 1)], row)
        return {"canvas": seen_canvas, "of": of, "masks": masks, "weights": self.spoiled(masks), "class": cls, "kind": kind, "row": row, "loose": loose}

    @torch.no_grad()
    def cuts(self, batch, n):
        """Squares of `n` things of a batch (outlined ones first), on black, as the server cuts them, and their places among the K."""
        order = torch.rand(len(batch["of"]), device=self.device, generator=self.a.gen) + batch["loose"].float()
        at = order.argsort()[:n]
        x, m = batch["canvas"][batch["of"][at]], batch["masks"][at].float()[:, None]
        H, W = m.shape[-2:]
        # A window around the thing first: the masks are spoiled at its scale.
        xs, ys = m[:, 0].amax(1), m[:, 0].amax(2)
        ends = lambda line, N: (line.argmax(1).float(), N - line.flip(1).argmax(1).float())
        (x0, x1), (y0, y1) = ends(xs, W), ends(ys, H)
        side = torch.maximum(x1 - x0, y1 - y0) * 1.5
        zero = torch.zeros_like(side)
        theta = torch.stack([torch.stack([side / W, zero, (x0 + x1) / W - 1], -1), torch.stack([zero, side / H, (y0 + y1) / H - 1], -1)], 1)
        both = F.grid_sample(torch.cat([x, m], 1), F.affine_grid(theta, (len(x), 4, 288, 288), align_corners=False), align_corners=False)
        rgb, m = self.a.cut(both[:, :3], self.a.spoil(both[:, 3:]), torch.zeros(len(x), dtype=torch.bool, device=self.device))
        return self.a.soften(rgb, **FAR) * m, at

    @torch.no_grad()
    def wholes(self, n):
        """Class-labelled photographs as one cut each, whole or under a round outline: [n,3,SIDE,SIDE] and rows."""
        pick = self.a.pick(self.tile_weight, n)
        x = self.tiles[pick].permute(0, 3, 1, 2).float() / 255
        h, w = self.tile_size[pick].T
        inside = (torch.arange(TILE, device=self.device).view(1, 1, -1, 1) < h.view(-1, 1, 1, 1)) & (torch.arange(TILE, device=self.device).view(1, 1, 1, -1) < w.view(-1, 1, 1, 1))
        blob = (self.a.u(n, 1, 1, 1) < 0.35)
        mask = torch.where(blob, self.a.blob(n, TILE) * inside, inside.float())
        rgb, m = self.a.cut(x, mask, torch.zeros(n, dtype=torch.bool, device=self.device))
        return self.a.recolour(self.a.soften(rgb, **FAR)) * m, pick
