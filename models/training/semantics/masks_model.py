"""The mask network: an image encoder and a prompt decoder with SAM's contract.

The encoder gives ONE tensor `image_embeddings` [1, 56, S/4, S/4]: 48 channels of pixel features and, in
the last 8, the 128 channels of the 1/16 map moved into space. The decoder leaves the image alone:
only a few tokens a prompt are updated, then a mask is a small function of the pixel features that
the token writes. So a prompt costs a few million multiplications, and a grid of a thousand is cheap.
"""
import math

import torch
import torch.nn as nn
import torch.nn.functional as F

from lite import Lite2

PIXEL, COARSE, DIM, HIDDEN, NARROW = 48, 128, 192, 12, 16
LEVELS = 3


class Attention(nn.Module):
    """Multi-head attention with pre-norm of the queries; keys and values may have another width."""

    def __init__(self, dim, heads, other=None):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(dim)
        self.q, self.k, self.v, self.out = nn.Linear(dim, dim), nn.Linear(other or dim, dim), nn.Linear(other or dim, dim), nn.Linear(dim, dim)

    def forward(self, x, keys=None, values=None, bias=None):
        y = self.norm(x)
        keys, values = (y, y) if keys is None else (keys, values)
        split = lambda t: t.reshape(t.shape[0], t.shape[1], self.heads, -1).transpose(1, 2)
        q, k, v = split(self.q(y)), split(self.k(keys)), split(self.v(values))
        a = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
        if bias is not None:
            a = a + bias
        y = (a.softmax(-1) @ v).transpose(1, 2).reshape(x.shape[0], x.shape[1], -1)
        return x + self.out(y)


class Feed(nn.Module):
    def __init__(self, dim, mid):
        super().__init__()
        self.net = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, mid), nn.GELU(), nn.Linear(mid, dim))

    def forward(self, x):
        return x + self.net(x)


def conv(i, o, k=3):
    return nn.Sequential(nn.Conv2d(i, o, k, padding=k // 2, bias=False), nn.BatchNorm2d(o), nn.ReLU(inplace=True))


class Encoder(nn.Module):
    """[1,3,S,S], (x - 127) / 128 of 0..255, S divisible by 32 -> [1,56,S/4,S/4]."""

    def __init__(self, side=512):
        super().__init__()
        self.body = Lite2(head=False)
        n = side // 32
        self.lift = nn.Conv2d(352, 224, 1)
        self.place = nn.Parameter(torch.randn(1, n * n, 224) * 0.02)
        self.deep = nn.ModuleList([nn.ModuleList([Attention(224, 7), Feed(224, 448)]) for _ in range(2)])
        self.l5, self.l4, self.l3, self.l2 = nn.Conv2d(224, COARSE, 1), nn.Conv2d(120, COARSE, 1), nn.Conv2d(48, 96, 1), nn.Conv2d(24, 64, 1)
        self.m4, self.m3, self.m2 = conv(COARSE, COARSE), conv(96, 96), conv(64, 64)
        self.d3, self.d2 = nn.Conv2d(COARSE, 96, 1), nn.Conv2d(96, 64, 1)
        self.pixel = nn.Sequential(conv(64, 64), nn.Conv2d(64, PIXEL, 1))

    def forward(self, x):
        c2, c3, c4, c5 = self.body.features(x)
        t = self.lift(c5)
        b, c, h, w = t.shape
        t = t.flatten(2).transpose(1, 2) + self.place
        for attend, feed in self.deep:
            t = feed(attend(t))
        t = t.transpose(1, 2).reshape(b, c, h, w)
        up = lambda y: F.interpolate(y, scale_factor=2, mode="nearest")
        p4 = self.m4(self.l4(c4) + up(self.l5(t)))
        p3 = self.m3(self.l3(c3) + up(self.d3(p4)))
        p2 = self.m2(self.l2(c2) + up(self.d2(p3)))
        return torch.cat([self.pixel(p2), F.pixel_shuffle(p4, 4)], 1)


class Decoder(nn.Module):
    """Prompts of one image: `image_embeddings` [1,56,h,w], `point_coords` [B,N,2] (pixels of the S x S
    picture), `point_labels` [B,N] (1 in, 0 out, -1 padding) -> `low_res_masks` [B,3,h,w] logits, small to
    large, and `iou_predictions` [B,3]."""

    def __init__(self, side=512):
        super().__init__()
        self.side = side
        self.register_buffer("waves", torch.randn(2, DIM // 2) * 1.5)
        self.tokens = nn.Parameter(torch.randn(1, LEVELS + 1, DIM) * 0.1)
        self.label = nn.Embedding(3, DIM)
        self.sampled = nn.Linear(PIXEL + COARSE, DIM)
        self.layers = nn.ModuleList([nn.ModuleList([Attention(DIM, 6), Attention(DIM, 6), Feed(DIM, 384)]) for _ in range(3)])
        self.widen = nn.Linear(COARSE, DIM)
        out = PIXEL + (NARROW + 3) * HIDDEN + HIDDEN + HIDDEN + 1
        self.write = nn.ModuleList([nn.Sequential(nn.LayerNorm(DIM), nn.Linear(DIM, DIM), nn.GELU(), nn.Linear(DIM, out)) for _ in range(LEVELS)])
        self.iou = nn.Sequential(nn.LayerNorm(DIM), nn.Linear(DIM, DIM), nn.GELU(), nn.Linear(DIM, LEVELS))
        nn.init.zeros_(self.label.weight)

    def waves_of(self, xy):
        """[..., 2] in -1..1 -> [..., DIM]."""
        # Not a matrix product: a coordinate must not be rounded to half precision in training.
        a = (xy[..., :1] * self.waves[0] + xy[..., 1:] * self.waves[1]) * math.pi
        return torch.cat([a.sin(), a.cos()], -1)

    def grid(self, h, w, device):
        # Floats from the start: a graph traced from whole numbers gets 64-bit floats, which WebGPU has not.
        y = (torch.arange(h, device=device, dtype=torch.float32) + 0.5) / h * 2 - 1
        x = (torch.arange(w, device=device, dtype=torch.float32) + 0.5) / w * 2 - 1
        return torch.stack([x[None].expand(h, w), y[:, None].expand(h, w)], -1)

    def forward(self, image_embeddings, point_coords, point_labels):
        masks, iou = self.many(image_embeddings, point_coords[None], point_labels[None])
        return masks[0], iou[0]

    def many(self, e, coords, labels):
        """The same for G images with B prompts each: e [G,56,h,w], coords [G,B,N,2], labels [G,B,N]."""
        g, b, n = labels.shape
        pixel, coarse = e[:, :PIXEL], F.pixel_unshuffle(e[:, PIXEL:], 4)
        h, w = pixel.shape[-2:]
        # As SAM's ONNX file: a coordinate is a pixel, its centre half a pixel on.
        xy = (coords + 0.5) / self.side * 2 - 1
        at = torch.cat([F.grid_sample(m, xy.reshape(g, 1, b * n, 2), align_corners=False, padding_mode="border")[:, :, 0] for m in (pixel, coarse)], 1)
        given = (labels >= 0).to(e.dtype)[..., None]
        point = self.sampled(at.transpose(1, 2)).reshape(g, b, n, DIM) + self.waves_of(xy).to(e.dtype)
        point = point * given + self.label((labels + 1).clamp(0, 2).long())
        t = torch.cat([self.tokens.expand(g * b, -1, -1), point.reshape(g * b, n, DIM)], 1)
        ch, cw = coarse.shape[-2:]
        place = self.waves_of(self.grid(ch, cw, e.device)).reshape(1, ch * cw, DIM).to(e.dtype)
        values = self.widen(coarse.flatten(2).transpose(1, 2))
        keys = values + place
        for own, cross, feed in self.layers:
            t = own(t)
            # Prompts of an image stand in one row of queries: keys and values are made once.
            m = t.shape[1]
            t = cross(t.reshape(g, b * m, DIM), keys, values).reshape(g * b, m, DIM)
            t = feed(t)
        params = torch.stack([write(t[:, 1 + k]) for k, write in enumerate(self.write)], 1).reshape(g, b * LEVELS, -1)
        return self.masks(pixel, params, xy[:, :, 0]).reshape(g, b, LEVELS, h, w), self.iou(t[:, 0]).reshape(g, b, LEVELS).sigmoid()

    def masks(self, pixel, params, first):
        """Logits [G, B * levels, h * w]; `first` [G,B,2] is where each prompt's first point lies, -1..1."""
        g, _, h, w = pixel.shape
        rows = params.shape[1]
        flat = pixel.flatten(2)
        direct, hidden, bias, out, offset = params.split([PIXEL, (NARROW + 3) * HIDDEN, HIDDEN, HIDDEN, 1], -1)
        hidden = hidden.reshape(g, rows * HIDDEN, NARROW + 3)
        logits = direct @ flat + offset
        # What lies where, seen from the point: x, y and distance from it.
        centre = first.repeat_interleave(LEVELS, 1).repeat_interleave(HIDDEN, 1)
        grid = self.grid(h, w, pixel.device).reshape(1, h * w, 2).transpose(1, 2)
        wx, wy, wd = hidden[..., NARROW : NARROW + 1], hidden[..., NARROW + 1 : NARROW + 2], hidden[..., NARROW + 2 :]
        shift = bias.reshape(g, rows * HIDDEN, 1) - wx * centre[..., :1] - wy * centre[..., 1:]
        seen = torch.cat([flat[:, :NARROW], grid.expand(g, -1, -1).to(flat.dtype)], 1)
        spatial = torch.cat([hidden[..., :NARROW], wx, wy], -1) @ seen + shift.to(flat.dtype)
        f = first.repeat_interleave(LEVELS, 1)
        d2 = (grid[:, :1].expand(g, 1, -1) - f[..., :1]) ** 2 + (grid[:, 1:] - f[..., 1:]) ** 2
        near = torch.exp(-d2 * 12.0).to(flat.dtype)
        hid = spatial.reshape(g, rows, HIDDEN, h * w) + wd.reshape(g, rows, HIDDEN, 1) * near[:, :, None]
        logits = logits + (out.reshape(g, rows, 1, HIDDEN) @ hid.relu())[:, :, 0]
        return logits


class MaskNet(nn.Module):
    def __init__(self, side=512):
        super().__init__()
        self.encoder, self.decoder = Encoder(side), Decoder(side)

    def forward(self, images, coords, labels):
        return self.decoder.many(self.encoder(images), coords, labels)
