"""Pictures out of a pack, and the squares of them that the image tower looks at."""
import io
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from words_model import SIDE

POOL = ThreadPoolExecutor(min(32, (os.cpu_count() or 1) * 2))


def decoded(blob, at, i, mode="RGB"):
    """Picture `i` of those that lie one after another in `blob`, [h,w,c] or [h,w] u8."""
    return np.array(Image.open(io.BytesIO(blob[at[i] : at[i + 1]].tobytes())).convert(mode))


def decode(z, blob="blob", at="offsets", mode="RGB"):
    """All pictures of a file of a pack."""
    data, off = z[blob], z[at]
    return list(POOL.map(lambda i: decoded(data, off, i, mode), range(len(off) - 1)))


def letterbox(a, size, resample=Image.BICUBIC):
    """A picture [h,w,c] in the middle of a black square."""
    k = size / max(a.shape[:2])
    w, h = max(1, round(a.shape[1] * k)), max(1, round(a.shape[0] * k))
    small = np.asarray(Image.fromarray(a).resize((w, h), resample))
    out = np.zeros((size, size, a.shape[2]), np.uint8)
    y, x = (size - h) // 2, (size - w) // 2
    out[y : y + h, x : x + w] = small
    return out


def cornered(a, side, resample=Image.BICUBIC):
    """A picture in the top left corner of a black square, longer side `side`, and its height and width there."""
    k = side / max(a.shape[:2])
    w, h = max(1, round(a.shape[1] * k)), max(1, round(a.shape[0] * k))
    out = np.zeros((side, side, *a.shape[2:]), np.uint8)
    out[:h, :w] = np.asarray(Image.fromarray(a).resize((w, h), resample))
    return out, h, w


def windows(photo, boxes, size, context):
    """What lies around each of `boxes` [K,4] (x0, y0, x1, y1) of a photo [C,h,w] or of one a box [K,C,h,w], 0..255, as
    squares u8 [K,size,size,C]; 0 beyond the photo."""
    h, w = photo.shape[-2:]
    x = photo.float().expand(len(boxes), *photo.shape[-3:])
    x0, y0, x1, y1 = torch.as_tensor(np.array(boxes, np.float32), device=x.device).T
    side = torch.maximum(x1 - x0, y1 - y0) * (1 + 2 * context)
    zero = torch.zeros_like(side)
    theta = torch.stack([torch.stack([side / w, zero, (x0 + x1) / w - 1], -1), torch.stack([zero, side / h, (y0 + y1) / h - 1], -1)], 1)
    grid = F.affine_grid(theta, (len(boxes), 1, size, size), align_corners=False)
    return F.grid_sample(x, grid, align_corners=False).round().byte().permute(0, 2, 3, 1)


def box_of(mask):
    """Centre and size, each (of x, of y) and in -1..1, of masks [B,R,R] bool."""
    R, ends = mask.shape[-1], []
    for axis in (1, 2):
        line = mask.any(axis).float()
        first, last = line.argmax(1).float(), R - line.flip(1).argmax(1).float()
        ends.append(((first + last) / R - 1, (last - first) / R * 2))
    (cx, w), (cy, h) = ends
    return (cx, cy), (w, h)


def exact(bank, dim, margin):
    """The cuts of windows [K,R,R,4], as the server makes them."""
    out = []
    for x in bank.split(64):
        x = x.permute(0, 3, 1, 2).float() / 255
        m = (x[:, 3:] > 0.5).float()
        (cx, cy), (w, h) = box_of(m[:, 0] > 0.5)
        k = torch.maximum(w, h) / 2 * (1 + 2 * margin)
        zero = torch.zeros_like(k)
        theta = torch.stack([torch.stack([k, zero, cx], -1), torch.stack([zero, k, cy], -1)], 1)
        both = F.grid_sample(torch.cat([x[:, :3], m], 1), F.affine_grid(theta, (len(x), 1, SIDE, SIDE), align_corners=False), align_corners=False)
        inside = (both[:, 3:] > 0.5).float()
        out.append(both[:, :3] * (inside + (1 - inside) * dim))
    return torch.cat(out)
