"""Packs photographs, outlines, words, the judge and the weights to begin with for `train_pooled.py`.

    python pooled_pack.py --data ../../../../shared/data --wordnet DICT --bundle ../../embedded --out PACK

photos_SET.npz  photographs (WebP: blob, offsets) with index pictures (PNG: mask, mask_at), key, part (0 train, 1 held out,
                2 judge), thing [N,4]: photo, index, class (-1: no name), whether the mask is a box
labelled.npz    class-labelled photographs: blob, offsets, label (class), held
words.npz       words and their embeddings by the bundle's text tower, canon, truth of each class (1, 0, -1 open), own word
                and name of each class, which classes are withheld, the everyday words
judge.json      judged things: set, key, index, label, words asked and which of them may be said
start.npz       the image tower of the bundle
A photograph with a withheld thing goes to the judge or to training by its name, half each (of rooms a quarter); in training
the thing itself is never shown.
"""
import argparse
import io
import json
import os
import tarfile
import zlib
from collections import Counter

import numpy as np
from PIL import Image

import cuts
import naming
from colours import COLOURS
from heldout import heldout, withheld_words
from pack_real import blobs
from pooled_photos import CUTOUTS, HELD, JUDGE, TRAIN
from prepare import CALTECH, Vocabulary, labelled, webp
from towers import folded
from truths import embedded, more_nouns, synonyms, truth_table
from wordnet import WordNet

OUTLINED = (*cuts.SETS, "rooms_polygons", "pantry_polygons", "tools_polygons")
BOXED = ("boxes_rooms", "boxes_doors", "boxes_groceries", "boxes_misc")
CHOOSING = ("wooden_sculpture", "blowtorch", "milk_carton")  # these choose; they are never trained on
SIDE, QUALITY = 320, 72
TINY_A_CLASS = 50
JUDGED_A_NAME = 20  # of one name in one set


def small(photo, label):
    """A photograph and its index picture, short side at most SIDE, as bytes."""
    img, mask = Image.fromarray(photo), Image.fromarray(label)
    k = min(1, SIDE / min(img.size))
    if k < 1:
        size = [round(x * k) for x in img.size]
        img, mask = img.resize(size, Image.BICUBIC), mask.resize(size, Image.NEAREST)
    buf = io.BytesIO()
    mask.save(buf, "PNG")
    return webp(img, QUALITY), buf.getvalue()


def outlined(images, name):
    """(order, key, photo, index picture, [(index, label)], are they boxes) of a set with outlines."""
    with tarfile.open(os.path.join(images, name + ".tar")) as tar:
        files = sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))
        root = files[0].split("images/")[0]
        segments = json.load(tar.extractfile(root + "segments.json"))
        for i, file in enumerate(files):
            key = os.path.basename(file)[:-4]
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            label = np.array(Image.open(io.BytesIO(tar.extractfile(f"{root}masks/{key}.png").read())))
            found = [(s["index"], cuts.plain(s["name"])) for s in segments[key]["segments"] if not s["iscrowd"] and s["name"] != "background"]
            yield i, key, photo, label.astype(np.uint8), found, False


def boxed(images, name):
    with tarfile.open(os.path.join(images, name + ".tar")) as tar:
        files = sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))
        root = files[0].split("images/")[0]
        boxes = json.load(tar.extractfile(root + "boxes.json"))
        for i, file in enumerate(files):
            key = os.path.basename(file)[:-4]
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            label, found = np.zeros(photo.shape[:2], np.uint8), []
            k = photo.shape[1] / boxes[key]["width"]
            rows = sorted(boxes[key]["boxes"], key=lambda b: -(b["box"][2] - b["box"][0]) * (b["box"][3] - b["box"][1]))[:250]
            for n, b in enumerate(rows, 1):
                x0, y0, x1, y1 = (int(round(v * k)) for v in b["box"])
                label[max(y0, 0) : y1, max(x0, 0) : x1] = n
                found.append((n, cuts.plain(b["name"])))
            yield i, key, photo, label, found, True


def regions(images):
    """BSDS500: regions that a person drew, without names."""
    with tarfile.open(os.path.join(images, "bsds500.tar")) as tar:
        for i, file in enumerate(sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))):
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            seg = np.asarray(Image.open(io.BytesIO(tar.extractfile(file.replace("images/", "segs/")[:-4] + "_1.png").read()))).astype(np.int64)
            seg = (np.unique(seg, return_inverse=True)[1].reshape(seg.shape) + 1).clip(0, 255).astype(np.uint8)
            yield i, os.path.basename(file)[:-4], photo, seg, [(int(n), None) for n in np.unique(seg)], False


def people(images):
    with tarfile.open(os.path.join(images, "human_seg.tar")) as tar:
        for i, file in enumerate(sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))):
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            mask = Image.open(io.BytesIO(tar.extractfile(file.replace("images/", "masks/")[:-4] + ".png").read())).convert("L")
            mask = (np.asarray(mask.resize(photo.shape[1::-1], Image.NEAREST)) > 127).astype(np.uint8)
            yield i, os.path.basename(file)[:-4], photo, mask, [(1, "person")], False


def unlabelled(images):
    with tarfile.open(os.path.join(images, "coco_unlabelled.tar")) as tar:
        for i, file in enumerate(sorted(n for n in tar.getnames() if n.endswith(".jpg"))):
            photo = np.asarray(Image.open(io.BytesIO(tar.extractfile(file).read())).convert("RGB"))
            yield i, os.path.basename(file)[:-4], photo, np.zeros(photo.shape[:2], np.uint8), [], False


def scene(folder):
    classes = json.load(open(os.path.join(folder, "masks", "classes.json")))
    names = sorted(n for n in os.listdir(os.path.join(folder, "masks")) if n.endswith(".png"))
    several = [n for n in names if len(np.unique(np.asarray(Image.open(os.path.join(folder, "masks", n))))) > 2]
    # The photos in which several things are labelled, and four spread ones of the rest.
    rest = [n for n in names if n not in several]
    for i, n in enumerate(sorted(several + [rest[k] for k in np.unique(np.linspace(0, len(rest) - 1, 4).round().astype(int))])):
        photo = np.asarray(Image.open(os.path.join(folder, "images", n[:-4] + ".jpg")).convert("RGB"))
        label = np.array(Image.open(os.path.join(folder, "masks", n))).astype(np.uint8)
        yield i, n[:-4], photo, label, [(int(v), w) for v, w in classes.items() if (label == int(v)).any()], False


class Names:
    """The classes, their words and what is true of them, which are withheld: what words.npz holds."""

    def __init__(self, args, everyday):
        images, net = os.path.join(args.data, "images"), WordNet(args.wordnet)
        self.vocab, self.also = Vocabulary(net), synonyms(args.data)
        add = self.vocab.add
        z = np.load(os.path.join(images, "imagenet1k_samples.npz"))
        self.thousand = [add(str(n), str(w)) for n, w in zip(z["class_names"], z["wnid"])]
        # (set, order, bytes, class) of the class-labelled photographs.
        self.labelled = [(s, i, jpeg, add(CALTECH.get(w, w.replace("_", " ")) if s == "caltech101" else w, wnid)) for s, i, jpeg, w, wnid in labelled(args.data)]
        self.index = {n: add(n) for n in sorted({"person"} | drawn_names(images))}
        for c in self.vocab.classes:
            c["true"] = list(dict.fromkeys(c["true"] + [self.vocab.word(w) for w in sorted(self.also.get(c["name"], ()))]))
        for w in sorted(set(everyday.alike) | set(everyday.words) | withheld_words()):
            self.vocab.word(w)
        self.colours = [self.vocab.word(c) for c in COLOURS]
        more_nouns(self.vocab, net, np.random.default_rng(9))
        self.net, self.everyday = net, everyday

    def write(self, args, bundle):
        v = self.vocab
        mine, raw = embedded(args.bundle, bundle, v.words)
        truth = truth_table(v, self.net, self.everyday, raw, np.array(self.colours))
        # A class is withheld when a withheld word, or another word for one, is its name, or a withheld word is true of it.
        listed = withheld_words()
        away = listed | {s for w in listed for s in self.also.get(w, ())} | {n for n, s in self.also.items() if s & listed}
        own = np.array([c["own"] for c in v.classes])
        at = lambda words: sorted(v.index[w] for w in words if w in v.index)
        self.withheld = (truth[:-1][:, at(listed)] == 1).any(1) | np.isin(own, at(away))
        np.savez_compressed(os.path.join(args.out, "words.npz"), words=np.array(v.words), embed=mine.astype(np.float16), canon=bundle.texts(bundle.manifest["canon"]),
                            truth=truth, own=own, thousand=np.array(self.thousand), names=np.array([c["name"] for c in v.classes]), withheld=self.withheld,
                            colours=np.array(self.colours), everyday=np.array([v.index[w] for w in self.everyday.words]))
        print("words", len(v.words), "classes", len(v.classes), "withheld", int(self.withheld.sum()), flush=True)

    def open(self, label):
        """Whether a label is a withheld name."""
        return label in self.index and bool(self.withheld[self.index[label]])


def drawn_names(images):
    """The names under which things are outlined or boxed."""
    def rows(sets, file, inside):
        for name in sets:
            with tarfile.open(os.path.join(images, name + ".tar")) as tar:
                found = json.load(tar.extractfile([n for n in tar.getnames() if n.endswith(file)][0]))
            yield from (cuts.plain(s["name"]) for v in found.values() for s in v[inside] if s["name"] != "background")

    return {*rows((*OUTLINED, *CUTOUTS), "segments.json", "segments"), *rows(BOXED, "boxes.json", "boxes")}


def part_of(name, order, key, is_open):
    """What a photograph is for; `is_open`: whether something in it has a withheld name."""
    if name.startswith("scene_"):
        return JUDGE
    if name in ("bsds500", "coco_unlabelled"):
        return TRAIN
    if heldout(order):
        return HELD
    if is_open and (name in CUTOUTS or zlib.crc32(key.encode()) % (4 if name == "rooms_polygons" else 2) == 1):
        return JUDGE
    return TRAIN


class Judged:
    """The things that are judged."""

    def __init__(self, names):
        self.names, self.things, self.count = names, [], Counter()

    def add(self, name, part, photo, n, label, mask, labels):
        """Thing `n` of a photo, if it is large enough and its name is wanted."""
        ys, xs = np.nonzero(mask)
        if len(ys) < 0.003 * mask.size or max(np.ptp(ys), np.ptp(xs)) + 1 < 16:
            return
        kind = "scenes" if name.startswith("scene_") else "open" if self.names.open(label) else "held" if part == HELD else None
        if kind is None or kind != "scenes" and self.count[name, label] >= JUDGED_A_NAME:
            return
        self.count[name, label] += 1
        everyday = self.names.everyday
        asked = list(dict.fromkeys(labels + everyday.words))
        self.things.append({"kind": kind, "set": name, "photo": photo, "index": n, "label": label, "asked": asked, "good": [int(everyday.may_be_said(label, x)) for x in asked]})

    def write(self, args, bundle):
        texts = sorted({x for j in self.things for x in j["asked"]})
        order = {x: i for i, x in enumerate(texts)}
        for j in self.things:
            j["asked"], j["label_at"] = [order[x] for x in j["asked"]], order[j["label"]]
        json.dump({"texts": texts, "things": self.things}, open(os.path.join(args.out, "judge.json"), "w"))
        np.save(os.path.join(args.out, "judge_texts.npy"), embedded(args.bundle, bundle, texts)[0].astype(np.float32))
        print("judged", Counter(j["kind"] for j in self.things), "names", {k: len({j["label"] for j in self.things if j["kind"] == k}) for k in ("open", "held", "scenes")}, flush=True)


def whole(photo, label):
    """A photograph of a posed scene and its index picture, as bytes, at their own size."""
    a, b = io.BytesIO(), io.BytesIO()
    Image.fromarray(photo).save(a, "JPEG", quality=95)
    Image.fromarray(label).save(b, "PNG")
    return a.getvalue(), b.getvalue()


def pack_set(args, name, found, names, judged):
    """photos_SET.npz; what is judged of it goes into `judged`."""
    pics, masks, keys, parts, things = [], [], [], [], []
    for i, key, photo, label, here, loose in found:
        part = part_of(name, i, key, any(names.open(w) for _, w in here))
        a, b = (whole if name.startswith("scene_") else small)(photo, label)
        pics.append(a), masks.append(b)
        p, labels = len(keys), sorted({w for _, w in here if w})
        keys.append(key), parts.append(part)
        for n, w in here:
            things.append((p, n, names.index.get(w, -1), loose))
            if part != TRAIN and not loose and w is not None:
                judged.add(name, part, p, n, w, label == n, labels)
    (a, b), (c, d) = blobs(pics), blobs(masks)
    path = os.path.join(args.out, f"photos_{name}.npz")
    np.savez(path, blob=a, offsets=b, mask=c, mask_at=d, key=np.array(keys), part=np.array(parts, np.uint8), thing=np.array(things, np.int32).reshape(-1, 4))
    print(name, len(keys), "parts", np.bincount(parts, minlength=3).tolist(), "things", len(things), os.path.getsize(path) >> 10, "KiB", flush=True)


def pack_labelled(args, rows):
    """labelled.npz: of Tiny ImageNet the first of each class as they are, others with a short side of 128."""
    count, kept = Counter(), []
    for name, i, jpeg, c in rows:
        count[name, c] += 1
        if name != "tiny_imagenet":
            img = Image.open(io.BytesIO(jpeg)).convert("RGB")
            k = min(1, 128 / min(img.size))
            kept.append((webp(img.resize([max(1, round(x * k)) for x in img.size], Image.BICUBIC), 66), c, heldout(i)))
        elif count[name, c] <= TINY_A_CLASS:
            kept.append((jpeg, c, heldout(i)))
    a, b = blobs([k[0] for k in kept])
    np.savez(os.path.join(args.out, "labelled.npz"), blob=a, offsets=b, label=np.array([k[1] for k in kept]), held=np.array([k[2] for k in kept]))
    print("labelled", len(kept), flush=True)


def main():
    ap = argparse.ArgumentParser()
    for name in ["data", "wordnet", "bundle", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--scenes", nargs="*", default=CHOOSING, help="posed scenes that are judged")
    ap.add_argument("--only", nargs="*", help="pack pictures of these sets alone (scene_NAME for a posed scene)")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    images = os.path.join(args.data, "images")
    names, bundle = Names(args, naming.Everyday(WordNet(args.wordnet))), naming.Bundle(args.bundle, threads=2)
    names.write(args, bundle)
    tower = folded(os.path.join(args.bundle, bundle.manifest["image"]["file"]))
    np.savez(os.path.join(args.out, "start.npz"), **{k: v.numpy().astype(np.float16) for k, v in tower.items()})
    sources = {n: outlined(images, n) for n in (*OUTLINED, *CUTOUTS)} | {n: boxed(images, n) for n in BOXED}
    sources |= {"human_seg": people(images), "bsds500": regions(images), "coco_unlabelled": unlabelled(images)}
    sources |= {"scene_" + n: scene(os.path.join(args.data, "scenes", n)) for n in args.scenes}
    judged = Judged(names)
    for name, found in sources.items():
        if not args.only or name in args.only:
            pack_set(args, name, found, names, judged)
    judged.write(args, bundle)
    if not args.only:
        pack_labelled(args, names.labelled)


if __name__ == "__main__":
    main()
