"""What everything-mode keeps of each labelled thing: how the settings of the mask stage were chosen.

    python everything.py --data ../../../../shared/data --bundle ../../embedded [--points 32] [--every 1] \
        "surest=0,iou=0.35,stable=0.6" "surest=1,iou=0.2,stable=0.4"

Photographs: the held-out ones of the labelled sets (`cuts.py`), which no training sees. Each argument is a setting; a
row says the mean IoU of the best mask of each labelled thing after NMS and with one mask a pixel, the share over 0.5,
masks and points asked a photo. The first row is the best of all proposals, before any filter. As `crates/vision/src/segment`, without seeds, NMS of
boxes and the finer map.
"""
import argparse
import itertools
import os

import numpy as np
import onnxruntime as ort
from PIL import Image

import cuts

SIDE, BATCH, LEAST, MOST = 512, 64, 0.0008, 0.95
STRIDES = (4, 2, 1)


def order(side):
    """(point, round) in the server's order."""
    of = [(next(r for r, s in enumerate(STRIDES) if (x % s == s // 2 and y % s == s // 2) or s == 1), y * side + x) for y in range(side) for x in range(side)]
    return [(at, r) for r, at in sorted(of)]


def decoded(nets, photo, side):
    """Masks [P,3,cells], predicted IoU and stability [P,3] of the whole grid, and [h,w] of the cells."""
    encoder, decoder = nets
    k = SIDE / max(photo.shape[:2])
    w, h = round(photo.shape[1] * k), round(photo.shape[0] * k)
    x = np.zeros((1, 3, SIDE, SIDE), np.float32)
    x[0, :, :h, :w] = ((np.asarray(Image.fromarray(photo).resize((w, h), Image.BILINEAR), np.float32) - 127) / 128).transpose(2, 0, 1)
    embedding = encoder.run(None, {"images": x})[0]
    gh, gw = -(-h // 4), -(-w // 4)
    g = (np.arange(side) + 0.5) / side
    points = (np.stack(np.meshgrid(g, g), -1).reshape(-1, 1, 2) * [w, h] - 0.5).astype(np.float32)
    masks, iou, stability = [], [], []
    for part in np.split(points, range(BATCH, len(points), BATCH)):
        logits, predicted = decoder.run(None, {"image_embeddings": embedding, "point_coords": part, "point_labels": np.ones((len(part), 1), np.float32)})
        logits = logits[:, :, :gh, :gw].reshape(len(part), 3, -1)
        masks.append(logits > 0)
        iou.append(predicted)
        stability.append((logits > 1).sum(2) / np.maximum((logits > -1).sum(2), 1))
    return np.concatenate(masks), np.concatenate(iou), np.concatenate(stability), (gh, gw)


def kept(masks, predicted, stability, hw, side, surest=1, iou=0.2, stable=0.4, nms=0.6, part=0.85, size=0.1):
    """One mask a pixel: bool [K,cells], and how many points were asked."""
    cells = masks.shape[2]
    area = masks.sum(2)
    ok = (predicted > iou) & (stability >= stable) & (area >= LEAST * cells) & (area <= MOST * cells)
    sure = predicted * stability if surest else predicted
    covered, covered_small = np.zeros(cells, bool), np.zeros(cells, bool)
    waiting, found, asked = order(side)[::-1], [], 0
    while waiting:
        batch = []
        while waiting and len(batch) < BATCH:
            at, turn = waiting.pop()
            y, x = divmod(at, side)
            cell = int((y + 0.5) / side * hw[0]) * hw[1] + int((x + 0.5) / side * hw[1])
            if not (covered if turn == 2 else covered_small)[cell]:
                batch.append(at)
        asked += len(batch)
        for at in batch:
            if ok[at].any():
                level = 2 - int(np.argmax(ok[at][::-1]))
                found.append((at, level))
                if level == 2:
                    covered |= masks[at, 2]
                    if area[at, 2] < 0.1 * cells:
                        covered_small |= masks[at, 2]
    found.sort(key=lambda m: -sure[m])
    common = lambda a, b: int((masks[a] & masks[b]).sum())
    stay = []
    for m in found:
        alike = lambda o: min(area[m], area[o]) > nms * max(area[m], area[o]) and (c := common(m, o)) > nms * (area[m] + area[o] - c)
        if not any(alike(o) for o in stay):
            stay.append(m)
    wholes = [m for m in stay if not any(o[1] > m[1] and area[o] > area[m] and common(o, m) >= part * area[m] for o in stay)]
    wholes.sort(key=lambda m: size * np.log(area[m]) - sure[m] if surest else area[m])
    taken, out = np.zeros(cells, bool), []
    for m in wholes:
        mask = masks[m] & ~taken
        if mask.sum() >= LEAST * cells:
            taken |= mask
            out.append(mask)
    return np.array(out, bool).reshape(-1, cells), asked


def best(truth, masks):
    """IoU of each of truth [T,cells] with its best mask [K,cells]."""
    if not len(masks):
        return np.zeros(len(truth))
    t, m = truth.astype(np.float32), masks.astype(np.float32)
    both = t @ m.T
    return (both / (t.sum(1)[:, None] + m.sum(1) - both).clip(1)).max(1)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--data", required=True)
    ap.add_argument("--bundle", required=True)
    ap.add_argument("--points", type=int, default=32, help="along a side")
    ap.add_argument("--every", type=int, default=1, help="only every so many photographs")
    ap.add_argument("settings", nargs="+", help="surest=0|1, iou=, stable=, nms=, part=, size=")
    args = ap.parse_args()
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    nets = [ort.InferenceSession(os.path.join(args.bundle, n), options, providers=["CPUExecutionProvider"]) for n in ("mask_encoder.onnx", "mask_decoder.onnx")]
    rows = {s: ([], 0, 0) for s in ["all proposals", *args.settings]}
    images, photographs = os.path.join(args.data, "images"), 0
    held_out = itertools.chain.from_iterable(cuts.things(images, name, "heldout") for name in cuts.SETS)
    for _, photo, things in itertools.islice(held_out, 0, None, args.every):
        photographs += 1
        masks, predicted, stability, hw = decoded(nets, photo, args.points)
        truth = [np.asarray(Image.fromarray(m.astype(np.uint8) * 255).resize(hw[::-1], Image.BOX)).ravel() > 127 for _, m in things]
        for s, (values, count, points) in rows.items():
            if s == "all proposals":
                found, asked = masks.reshape(-1, masks.shape[2]), len(masks)
            else:
                said = {k: float(v) for k, v in (pair.split("=") for pair in s.split(","))}
                found, asked = kept(masks, predicted, stability, hw, args.points, **said)
            values.append(best(np.array(truth), found))
            rows[s] = (values, count + len(found), points + asked)
    for s, (values, count, points) in rows.items():
        v = np.concatenate(values)
        print(f"{s}: mean IoU {v.mean():.3f}, over 0.5 {(v > 0.5).mean():.3f}, {len(v)} things, masks {count / photographs:.1f}, asked {points / photographs:.0f}")


if __name__ == "__main__":
    main()
