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
from collections import Counter, defaultdict

import numpy as np
import onnx
import onnxruntime as ort
from PIL import Image

import cuts
import naming
from colours import COLOURS
from heldout import heldout
from pack_real import blobs, everyday_names
from pooled_photos import CUTOUTS, HELD, JUDGE, TRAIN
from prepare import CALTECH, Vocabulary, labelled, webp
from towers import folded
from wordnet import BODILY, GENERAL, WordNet

HERE = os.path.dirname(os.path.abspath(__file__))
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


def synonyms(data):
    """name -> other words for it, of both lists, in both directions."""
    out = defaultdict(set)
    for name, also in [*json.load(open(os.path.join(data, "images", "synonyms.json"))).items(), *everyday_names().items()]:
        out[name] |= set(also)
    return out


def withheld_words():
    return {w for row in open(os.path.join(HERE, "withheld.txt")) if not row.startswith("#") for w in row.strip().split(", ") if w}


def embed(bundle_dir, bundle, words):
    """Embeddings of words, and in the space before it is centred and turned, where likeness means likeness."""
    model = onnx.load(os.path.join(bundle_dir, bundle.manifest["text"]["file"]))
    sub = next(n for n in model.graph.node if n.op_type == "Sub" and "centre" in n.input)
    model.graph.output.append(onnx.helper.make_tensor_value_info(sub.input[0], onnx.TensorProto.FLOAT, None))
    run = ort.InferenceSession(model.SerializeToString())
    ids = [bundle.tokens.encode(w.lower()).ids[:24] for w in words]
    mine, raw, by = [None] * len(words), [None] * len(words), defaultdict(list)
    for i, t in enumerate(ids):
        by[len(t)].append(i)
    for group in by.values():
        for k in range(0, len(group), 256):
            part = group[k : k + 256]
            for i, x, y in zip(part, *run.run(None, {"input_ids": np.array([ids[i] for i in part], np.int64)})):
                mine[i], raw[i] = x, y
    return np.stack(mine), np.stack(raw)


def truth_table(vocab, net, everyday, also, raw, colours):
    """[classes + 1, words]: 1 true of the class, 0 false, -1 left open."""
    below = defaultdict(set)
    for w in vocab.words:
        offs = [o for o in net.first.get(w, []) if net.kind[o] in BODILY]
        for o in set().union(*[net.lineage(o) | {o} for o in offs]) if offs else set():
            below[o].add(vocab.index[w])
    truth = np.zeros((len(vocab.classes) + 1, len(vocab.words)), np.int8)
    for i, c in enumerate(vocab.classes):
        truth[i, raw @ raw[c["own"]] > 0.62] = -1
        truth[i, sorted(below.get(c["offset"], set()))] = -1
        said = everyday.alike[c["name"]] | everyday.alike[c["name"].split()[-1]] | everyday.parts[c["name"]] | everyday.parts[c["name"].split()[-1]]
        truth[i, [vocab.index[w] for w in said & set(vocab.index)]] = -1
        truth[i, colours] = -1
        truth[i, c["true"]] = 1
    return truth


def main():
    ap = argparse.ArgumentParser()
    for name in ["data", "wordnet", "bundle", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--scenes", nargs="*", default=CHOOSING, help="posed scenes that are judged")
    ap.add_argument("--only", nargs="*", help="pack pictures of these sets alone (scene_NAME for a posed scene)")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda n: os.path.join(args.out, n)
    images = os.path.join(args.data, "images")
    net = WordNet(args.wordnet)
    vocab, also, everyday = Vocabulary(net), synonyms(args.data), naming.Everyday(net)
    rng = np.random.default_rng(9)

    # Classes, in one order whatever is packed.
    z = np.load(os.path.join(images, "imagenet1k_samples.npz"))
    thousand = [vocab.add(str(n), str(w)) for n, w in zip(z["class_names"], z["wnid"])]
    rows = []
    for name, i, jpeg, word, wnid in labelled(args.data):
        rows.append((name, i, jpeg, vocab.add(CALTECH.get(word, word.replace("_", " ")) if name == "caltech101" else word, wnid)))
    names = {"person"}
    for name in (*OUTLINED, *CUTOUTS):
        with tarfile.open(os.path.join(images, name + ".tar")) as tar:
            found = json.load(tar.extractfile([n for n in tar.getnames() if n.endswith("segments.json")][0]))
        names |= {cuts.plain(s["name"]) for v in found.values() for s in v["segments"]} - {"background"}
    for name in BOXED:
        with tarfile.open(os.path.join(images, name + ".tar")) as tar:
            found = json.load(tar.extractfile([n for n in tar.getnames() if n.endswith("boxes.json")][0]))
        names |= {cuts.plain(b["name"]) for v in found.values() for b in v["boxes"]}
    index = {n: vocab.add(n) for n in sorted(names)}
    for c in vocab.classes:
        c["true"] = list(dict.fromkeys(c["true"] + [vocab.word(w) for w in sorted(also.get(c["name"], ()))]))
    for w in sorted(set(everyday.alike) | set(everyday.words) | withheld_words()):
        vocab.word(w)
    colours = [vocab.word(c) for c in COLOURS]
    pool = [w for w, offs in net.first.items() if net.kind[offs[0]] in BODILY and len(w) < 16 and w.count(" ") < 2 and w.isascii()]
    pool.sort(key=lambda w: -len(net.first[w]) + rng.random())
    for w in pool[:2500]:
        if w not in GENERAL:
            vocab.word(w)
    bundle = naming.Bundle(args.bundle, threads=2)
    mine, raw = embed(args.bundle, bundle, vocab.words)
    truth = truth_table(vocab, net, everyday, also, raw, np.array(colours))
    # A class is withheld when a withheld word, or another word for one, is its name or true of it.
    away = set(withheld_words())
    away |= {s for w in withheld_words() for s in also.get(w, ())} | {n for n, s in also.items() if s & withheld_words()}
    away = sorted(vocab.index[w] for w in away if w in vocab.index)
    strict = sorted(vocab.index[w] for w in withheld_words())
    own = np.array([c["own"] for c in vocab.classes])
    withheld = (truth[:-1][:, strict] == 1).any(1) | np.isin(own, away)
    np.savez_compressed(at("words.npz"), words=np.array(vocab.words), embed=mine.astype(np.float16), canon=bundle.texts(bundle.manifest["canon"]), truth=truth, own=own,
                        thousand=np.array(thousand), names=np.array([c["name"] for c in vocab.classes]), withheld=withheld, colours=np.array(colours),
                        everyday=np.array([vocab.index[w] for w in everyday.words]))
    print("words", len(vocab.words), "classes", len(vocab.classes), "withheld", int(withheld.sum()), flush=True)
    np.savez(at("start.npz"), **{k: v.numpy().astype(np.float16) for k, v in folded(os.path.join(args.bundle, bundle.manifest["image"]["file"])).items()})

    sources = {n: outlined(images, n) for n in (*OUTLINED, *CUTOUTS)} | {n: boxed(images, n) for n in BOXED}
    sources |= {"human_seg": people(images), "bsds500": regions(images), "coco_unlabelled": unlabelled(images)}
    sources |= {"scene_" + n: scene(os.path.join(args.data, "scenes", n)) for n in args.scenes}
    judged, count = [], Counter()
    for name, found in sources.items():
        if args.only and name not in args.only:
            continue
        pics, masks, keys, parts, things = [], [], [], [], []
        for i, key, photo, label, things_here, loose in found:
            open_here = [n for n, w in things_here if w in index and withheld[index[w]]]
            if name.startswith("scene_"):
                part = JUDGE
            elif name in ("bsds500", "coco_unlabelled"):
                part = TRAIN
            elif heldout(i):
                part = HELD
            elif open_here and (name in CUTOUTS or zlib.crc32(key.encode()) % (4 if name == "rooms_polygons" else 2) == 1):
                part = JUDGE
            else:
                part = TRAIN
            if name.startswith("scene_"):
                buf, png = io.BytesIO(), io.BytesIO()
                Image.fromarray(photo).save(buf, "JPEG", quality=95)
                Image.fromarray(label).save(png, "PNG")
                pics.append(buf.getvalue()), masks.append(png.getvalue())
            else:
                a, b = small(photo, label)
                pics.append(a), masks.append(b)
            p, labels = len(keys), sorted({w for _, w in things_here if w})
            keys.append(key), parts.append(part)
            for n, w in things_here:
                things.append((p, n, index.get(w, -1), loose))
                area = label == n
                ys, xs = np.nonzero(area)
                if part == TRAIN or loose or w is None or len(ys) < 0.003 * area.size or max(np.ptp(ys), np.ptp(xs)) + 1 < 16:
                    continue
                is_open = w in index and bool(withheld[index[w]])
                kind = "scenes" if name.startswith("scene_") else "open" if is_open else "held" if part == HELD else None
                if kind is None or kind != "scenes" and count[name, w] >= JUDGED_A_NAME:
                    continue
                count[name, w] += 1
                asked = list(dict.fromkeys(labels + everyday.words))
                judged.append({"kind": kind, "set": name, "photo": p, "index": n, "label": w, "asked": asked, "good": [int(everyday.may_be_said(w, x)) for x in asked]})
        (a, b), (c, d) = blobs(pics), blobs(masks)
        np.savez(at(f"photos_{name}.npz"), blob=a, offsets=b, mask=c, mask_at=d, key=np.array(keys), part=np.array(parts, np.uint8), thing=np.array(things, np.int32).reshape(-1, 4))
        print(name, len(keys), "parts", np.bincount(parts, minlength=3).tolist(), "things", len(things), os.path.getsize(at(f"photos_{name}.npz")) >> 10, "KiB", flush=True)
    texts = sorted({x for j in judged for x in j["asked"]})
    emb, _ = embed(args.bundle, bundle, texts)
    order = {x: i for i, x in enumerate(texts)}
    for j in judged:
        j["asked"] = [order[x] for x in j["asked"]]
        j["label_at"] = order[j["label"]]
    json.dump({"texts": texts, "things": judged}, open(at("judge.json"), "w"))
    np.save(at("judge_texts.npy"), emb.astype(np.float32))
    print("judged", Counter(j["kind"] for j in judged), "names", {k: len({j["label"] for j in judged if j["kind"] == k}) for k in ("open", "held", "scenes")}, flush=True)

    if not args.only:
        count, kept = Counter(), []
        for name, i, jpeg, c in rows:
            count[name, c] += 1
            if name == "tiny_imagenet":
                if count[name, c] > TINY_A_CLASS:
                    continue
                kept.append((jpeg, c, heldout(i)))
            else:
                img = Image.open(io.BytesIO(jpeg)).convert("RGB")
                k = min(1, 128 / min(img.size))
                kept.append((webp(img.resize([max(1, round(x * k)) for x in img.size], Image.BICUBIC), 66), c, heldout(i)))
        a, b = blobs([k[0] for k in kept])
        np.savez(at("labelled.npz"), blob=a, offsets=b, label=np.array([k[1] for k in kept]), held=np.array([k[2] for k in kept]))
        print("labelled", len(kept), os.path.getsize(at("labelled.npz")) >> 10, "KiB")


if __name__ == "__main__":
    main()
