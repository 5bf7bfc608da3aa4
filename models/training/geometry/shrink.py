"""Captures and textures made smaller to travel: photos of at most 640 pixels and textures, as WebP.

    python shrink.py captures DATA OUT [--most 80]
    python shrink.py textures .pack/textures.npz OUT/textures.npz

DATA is of captures.py and pairs.py. Photos whose poses are bad, which photos.py leaves out, stay behind; of a long
capture every second or third photo stays.
"""
import io
import json
import os
import sys

import numpy as np
from PIL import Image

LONG_SIDE = 640
QUALITY = {"captures": 84, "textures": 62}
PX_MOST = 0.9  # as in photos.py, which needs torch


def webp(img, quality):
    buf = io.BytesIO()
    img.convert("RGB").save(buf, "WEBP", quality=quality, method=1)
    return buf.getvalue()


def capture(source, target, most):
    with open(os.path.join(source, "cameras.json")) as file:
        about = json.load(file)
    pairs = dict(np.load(os.path.join(source, "pairs.npz")))
    px, frames = pairs["px"], about["frames"]
    of = lambda i: px[(px[:, 0] == i) | (px[:, 1] == i), 2]
    keep = [i for i in range(len(frames)) if len(of(i)) and np.median(of(i)) < PX_MOST and np.isfinite(pairs["inverse"][i]).all()]
    keep = keep[:: -(-len(keep) // most)] if keep else []
    os.makedirs(target, exist_ok=True)
    total = 0
    for n, i in enumerate(keep):
        f = frames[i]
        img = Image.open(os.path.join(source, f["file"]))
        s = min(LONG_SIDE / max(img.size), 1)
        w, h = round(img.width * s), round(img.height * s)
        f["K"] = (np.diag([w / img.width, h / img.height, 1]) @ np.array(f["K"])).tolist()
        f["file"], f["width"], f["height"] = f"{n:03d}.webp", w, h
        blob = webp(img.resize((w, h), Image.LANCZOS), QUALITY["captures"])
        total += len(blob)
        with open(os.path.join(target, f["file"]), "wb") as file:
            file.write(blob)
    about["frames"] = [frames[i] for i in keep]
    with open(os.path.join(target, "cameras.json"), "w") as file:
        json.dump(about, file)
    place = {i: n for n, i in enumerate(keep)}
    pairs["px"] = np.array([(place[int(a)], place[int(b)], p) for a, b, p in px if int(a) in place and int(b) in place] or np.zeros((0, 3)))
    # A photo whose matches stayed behind has none of its own: what is known of it is kept.
    lost = [n for n in range(len(keep)) if not (pairs["px"][:, :2] == n).any()]
    pairs["px"] = np.concatenate([pairs["px"], [(n, n, np.median(of(keep[n]))) for n in lost]]) if lost else pairs["px"]
    for key in ("inverse", "gain"):
        pairs[key] = pairs[key][keep]
    pairs["overlap"] = pairs["overlap"][np.ix_(keep, keep)]
    np.savez_compressed(os.path.join(target, "pairs.npz"), **pairs)
    print(os.path.basename(source), len(keep), "of", len(frames), total >> 10, "KiB", flush=True)


def main():
    what, source, target = sys.argv[1:4]
    if what == "textures":
        z = np.load(source)
        blob, off = z["blob"].tobytes(), z["offsets"]
        blobs = [webp(Image.open(io.BytesIO(blob[a:b])), QUALITY[what]) for a, b in zip(off[:-1], off[1:])]
        np.savez(target, blob=np.frombuffer(b"".join(blobs), np.uint8), offsets=np.cumsum([0] + [len(b) for b in blobs]), assets=z["assets"])
        return
    most = int(sys.argv[5]) if len(sys.argv) > 5 else 80
    for name in sorted(os.listdir(source)):
        if os.path.exists(os.path.join(source, name, "pairs.npz")) and not os.path.exists(os.path.join(target, name, "pairs.npz")):
            capture(os.path.join(source, name), os.path.join(target, name), most)


if __name__ == "__main__":
    main()
