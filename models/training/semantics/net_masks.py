"""What the mask network makes of each drawn thing: the cuts that the image tower gets in the product.

    python net_masks.py --pack PACK --bundle ../../embedded --out net.npz [--workers 8] [--photos N]

Prompts are two points of each thing, one deep inside; of the six masks (two points, three levels) the one that fits
the outline best is kept, and another that overlaps with it, at times a part or the thing with its neighbour.
For drawn.npz and drawn_held.npz: bits_* [N,2,128,16] (128 x 128 bits of the 512-pixel square), iou_* [N,2].
"""
import argparse
import os
import time
from concurrent.futures import ThreadPoolExecutor
from queue import Queue

import numpy as np
import onnxruntime as ort
from PIL import Image

from pictures import decode

SIDE, GRID, LEAST = 512, 128, 0.4


def deep(mask):
    """A pixel (y, x) deep inside a mask [h,w] bool."""
    m = np.pad(mask, 1)
    while True:
        less = m[1:-1, 1:-1] & m[:-2, 1:-1] & m[2:, 1:-1] & m[1:-1, :-2] & m[1:-1, 2:]
        if not less.any():
            return np.argwhere(m[1:-1, 1:-1])[len(np.argwhere(m[1:-1, 1:-1])) // 2]
        m = np.pad(less, 1)


def masks_of(nets, photo, label, indices, rng):
    """bits [K,2,128,16] and IoU [K,2] of the things of one photograph [h,w,3] with index picture [h,w]."""
    encoder, decoder = nets
    k = SIDE / max(photo.shape[:2])
    w, h = round(photo.shape[1] * k), round(photo.shape[0] * k)
    x = np.zeros((1, 3, SIDE, SIDE), np.float32)
    small = np.asarray(Image.fromarray(photo).resize((w, h), Image.BILINEAR), np.float32)
    x[0, :, :h, :w] = ((small - 127) / 128).transpose(2, 0, 1)
    embedding = encoder.run(None, {"images": x})[0]
    gh, gw = -(-h // 4), -(-w // 4)
    truth = [np.asarray(Image.fromarray((label == n).astype(np.uint8) * 255).resize((gw, gh), Image.BOX)) > 127 for n in indices]
    truth = [t if t.any() else np.ones_like(t) for t in truth]
    points = []
    for t in truth:
        at = np.argwhere(t)
        points += [deep(t), at[rng.integers(len(at))]]
    xy = (np.array(points)[:, ::-1] * 4 + 2).astype(np.float32)
    coords = np.stack([xy, np.zeros_like(xy)], 1)
    logits = decoder.run(None, {"image_embeddings": embedding, "point_coords": coords, "point_labels": np.tile(np.float32([[1, -1]]), (len(xy), 1))})[0]
    made = (logits > 0).reshape(len(indices), 6, GRID, GRID)
    bits, iou = [], []
    for t, six in zip(truth, made):
        six = six.copy()
        six[:, gh:] = six[:, :, gw:] = False
        part = six[:, :gh, :gw]
        v = (part & t).sum((1, 2)) / np.maximum((part | t).sum((1, 2)), 1)
        best = int(v.argmax())
        others = [j for j in range(6) if j != best and v[j] >= LEAST]
        two = [best, others[rng.integers(len(others))] if others else best]
        bits.append(np.packbits(six[two], axis=-1))
        iou.append(v[two])
    return np.stack(bits), np.array(iou, np.float32)


def main():
    ap = argparse.ArgumentParser()
    for name in ["pack", "bundle", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) // 2))
    ap.add_argument("--photos", type=int, help="only so many photographs, to try the program")
    args = ap.parse_args()
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    idle, start, out = Queue(), time.time(), {}
    at = lambda n: os.path.join(args.bundle, n)
    for _ in range(args.workers):
        idle.put([ort.InferenceSession(at(n), options, providers=["CPUExecutionProvider"]) for n in ("mask_encoder.onnx", "mask_decoder.onnx")])
    pool = ThreadPoolExecutor(args.workers)
    for name in ("drawn", "drawn_held"):
        z = np.load(os.path.join(args.pack, name + ".npz"))
        photos, labels, thing = decode(z), decode(z, "mask", "mask_at", "L"), z["thing"]
        bits, iou = np.zeros((len(thing), 2, GRID, GRID // 8), np.uint8), np.zeros((len(thing), 2), np.float32)

        def one(p):
            rows = np.nonzero(thing[:, 0] == p)[0]
            if len(rows):
                nets = idle.get()
                bits[rows], iou[rows] = masks_of(nets, photos[p], labels[p], thing[rows, 1], np.random.default_rng(p))
                idle.put(nets)

        list(pool.map(one, range(len(photos))[: args.photos]))
        out["bits_" + name], out["iou_" + name] = bits, iou
        done = iou[:, 0] > 0
        print(f"{name}: {done.sum()} things, best mask mean IoU {iou[done, 0].mean():.3f}, over {LEAST} {(iou[done, 0] >= LEAST).mean():.3f}, {time.time() - start:.0f} s", flush=True)
    np.savez(args.out + ".tmp.npz", **out)
    os.rename(args.out + ".tmp.npz", args.out)


if __name__ == "__main__":
    main()
