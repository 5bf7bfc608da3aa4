"""Labelled things of real photographs, and the cut of one as the server makes it.

Read by the evaluation (naming.py) and by what packs the training data (pack_real.py). `things` gives
photographs with their named masks; `cut` gives the square that the image tower sees.
"""
import io
import json
import os
import tarfile

import numpy as np
from PIL import Image

from heldout import heldout

# Sets in the form of coco_panoptic_200.tar, with exact outlines and names.
SETS = ("coco_instances", "coco_panoptic_200", "furniture_seg", "household_polygons", "pets_trimaps", "ade20k_samples")
# Labels whose first sense is another one, and stuff classes in plain words.
SAY = {
    "mouse": "computer mouse", "tv": "television", "orange": "orange fruit", "remote": "remote control", "keyboard": "computer keyboard",
    "wall-other": "wall", "sky-other": "sky", "building-other": "building", "floor-other": "floor", "window-other": "window",
    "food-other": "food", "door-stuff": "door", "wall-tile": "tiled wall", "floor-wood": "wooden floor", "wall-wood": "wooden wall",
    "wall-brick": "brick wall", "wall-stone": "stone wall", "mirror-stuff": "mirror", "water-other": "water", "light": "lamp",
    "window-blind": "window blind", "playingfield": "playing field", "pottedplant": "potted plant", "tvmonitor": "television",
    "diningtable": "dining table", "aeroplane": "airplane", "motorbike": "motorcycle", "hair drier": "hair dryer",
}


def plain(label):
    """A label of a set as a person would type it."""
    label = label.replace("-merged", "")
    return SAY.get(label, label.replace("-", " "))


def square(photo, mask, margin=0.0, dim=0.0):
    """`photo` [h,w,3] u8 under `mask` [h,w] bool: the mask's box with `margin` of its longer side, as a square.

    Outside the mask the photo keeps the share `dim` of its brightness; what lies outside the photo is black.
    """
    ys, xs = np.nonzero(mask)
    x0, x1, y0, y1 = xs.min(), xs.max() + 1, ys.min(), ys.max() + 1
    longer = int(max(x1 - x0, y1 - y0))
    side = longer + 2 * int(round(margin * longer))
    left, top = int(x0) - (side - int(x1 - x0)) // 2, int(y0) - (side - int(y1 - y0)) // 2
    out = np.zeros((side, side, 3), np.uint8)
    a, b = max(left, 0), min(left + side, photo.shape[1])
    c, d = max(top, 0), min(top + side, photo.shape[0])
    part, inside = photo[c:d, a:b], mask[c:d, a:b, None]
    out[c - top : d - top, a - left : b - left] = np.where(inside, part, (part * dim).astype(np.uint8))
    return out


def things(images, name, part, least=0.003, side=16):
    """(key, photo [h,w,3], [(label, mask [h,w] bool)]) of one set's photographs.

    `part`: "train", "heldout" or "all". A thing under `least` of the photo or `side` pixels is left out.
    """
    with tarfile.open(os.path.join(images, name + ".tar")) as tar:
        files = sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))
        root = files[0].split("images/")[0]
        segments = json.load(tar.extractfile(root + "segments.json"))
        for i, file in enumerate(files):
            if part != "all" and heldout(i) != (part == "heldout"):
                continue
            key = os.path.basename(file)[:-4]
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            mask = np.asarray(Image.open(io.BytesIO(tar.extractfile(f"{root}masks/{key}.png").read())))
            out = []
            for s in segments[key]["segments"]:
                m = mask == s["index"]
                ys, xs = np.nonzero(m)
                if s["iscrowd"] or len(ys) < max(least * m.size, 1) or max(np.ptp(ys), np.ptp(xs)) + 1 < side:
                    continue
                out.append((plain(s["name"]), m))
            if out:
                yield key, photo, out


def scene(folder, frames):
    """The same of at most `frames` labelled photographs of a posed scene, spread over it."""
    classes = json.load(open(os.path.join(folder, "masks", "classes.json")))
    files = sorted(n for n in os.listdir(os.path.join(folder, "masks")) if n.endswith(".png"))
    for k in np.unique(np.linspace(0, len(files) - 1, min(frames, len(files))).round().astype(int)):
        key = files[k][:-4]
        photo = np.asarray(Image.open(os.path.join(folder, "images", key + ".jpg")).convert("RGB"))
        mask = np.asarray(Image.open(os.path.join(folder, "masks", files[k])))
        yield key, photo, [(n, mask == int(v)) for v, n in classes.items() if (mask == int(v)).any()]
