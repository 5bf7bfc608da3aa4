"""Naming: does the image tower know a real thing that was cut out along its labelled mask?

    python naming.py --bundle ../../embedded --data ../../../../shared/data [--wordnet DICT] [--split choosing]

Cuts are made as the server makes them (black outside the mask, or as --margin and --dim say), and scored
as the server scores them. A thing is *found* when its own name beats every canon phrase; the *right* word is
the best of the photo's own names and the 200 everyday words of everyday.txt when it is the name or may be
said of the same thing; an *absent* word is one that may not (everyday.txt and WordNet say which).

choosing: what is held out of the labelled sets. Constants are set on it.
reporting: the posed scenes, four labelled photographs each. They are only reported. A mask of red_kitchen holds all
things of its class in the photograph, so some cuts hold two. coke_can has no masks: --masks names a folder of
scenes in the layout of shared/data that adds some.
"""
import argparse
import json
import os
import tomllib
from collections import defaultdict

import numpy as np
import onnxruntime as ort
from PIL import Image
from tokenizers import Tokenizer

import cuts
from wordnet import WordNet

HERE = os.path.dirname(os.path.abspath(__file__))
SCENES = ("fox", "red_kitchen", "duck_toy", "coke_can")


class Everyday:
    """The everyday words, and which words may be said of one thing."""

    def __init__(self, net):
        self.net, self.words, self.alike, self.parts = net, [], defaultdict(set), defaultdict(set)
        for row in open(os.path.join(HERE, "everyday.txt")):
            row = row.strip()
            if not row or row.startswith("#"):
                continue
            whole, _, parts = row.partition(":")
            whole = [w.strip() for w in whole.split(",")]
            if parts:
                for w in whole:
                    self.parts[w] |= {p.strip() for p in parts.split(",")}
                continue
            self.words += whole[:2]
            for w in whole:
                self.alike[w] |= set(whole)
        self.words = list(dict.fromkeys(self.words))
        self.lines = {}

    def lineage(self, word):
        if word not in self.lines:
            senses = [o for w in (word, word.split()[-1]) for o in self.net.first.get(w, [])] if self.net else []
            self.lines[word] = (set(senses), set().union(*[self.net.lineage(o) for o in senses]) if senses else set())
        return self.lines[word]

    def may_be_said(self, label, word):
        parts = self.parts[label] | self.parts[label.split()[-1]]
        if word == label or word in self.alike[label] or word in self.alike[label.split()[-1]] or word in parts or "*" in parts:
            return True
        a, b = self.lineage(label), self.lineage(word)
        return bool(a[0] & b[1] or b[0] & a[1] or a[0] & b[0])


class Bundle:
    """The two towers of a bundle's folder, on the CPU."""

    def __init__(self, folder, threads=1, image=None):
        self.folder = folder
        self.manifest = tomllib.load(open(os.path.join(folder, "bundle.toml"), "rb"))["image_text"]
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        m = self.manifest
        self.image = ort.InferenceSession(image or os.path.join(folder, m["image"]["file"]), options)
        self.text = ort.InferenceSession(os.path.join(folder, m["text"]["file"]), options)
        self.tokens = Tokenizer.from_file(os.path.join(folder, m["text"]["tokenizer"]))

    def texts(self, words):
        out = []
        for w in words:
            ids = self.tokens.encode(w.lower()).ids[: self.manifest["text"]["context"]]
            out.append(self.text.run(None, {"input_ids": np.array([ids], np.int64)})[0][0])
        return np.stack(out)

    def pictures(self, squares):
        side, rows = self.manifest["image"]["size"], []
        mean, std = (np.array(self.manifest["image"][k], np.float32) for k in ("mean", "std"))
        for at in range(0, len(squares), 16):
            x = np.stack([np.asarray(Image.fromarray(s).resize((side, side), Image.BILINEAR), np.float32) / 255 for s in squares[at : at + 16]])
            rows.append(self.image.run(None, {"images": ((x - mean) / std).transpose(0, 3, 1, 2).astype(np.float32)})[0])
        return np.concatenate(rows)

    def floor(self, seen, words=None):
        """The score that a text must reach for each row: that of the canon with the margin, and that of the last rival of the bundle's list."""
        floor = (seen @ self.texts(self.manifest["canon"]).T).max(1) + self.manifest.get("margin", 0.0)
        share = self.manifest.get("rivals", 1.0)
        if share >= 1.0:
            return floor
        if words is None:
            words = self.texts([r["word"] for r in json.load(open(os.path.join(self.folder, self.manifest["words"]["file"]))) if r.get("rival", True)])
        return np.maximum(floor, np.sort(seen @ words.T, 1)[:, -max(1, int(share * len(words)))])

    def things(self, rows, margin=0.0, dim=0.0, context=True):
        """Unit rows of things as the server sees them: the cut, and their place in the whole photo where the bundle gives it."""
        seen = self.pictures([cuts.square(*r[3], margin=margin, dim=dim) for r in rows])
        of = self.manifest["image"].get("dense")
        if context and of:
            last, features = None, None
            for row, (photo, mask) in zip(seen, (r[3] for r in rows)):
                weight = max([(a, w) for a, w in of["weights"] if mask.mean() >= a], default=(0, 0))[1]
                if not weight:
                    continue
                if photo is not last:
                    last, features = photo, self.dense(photo, of)
                row += weight * self.context(features, mask)
        return seen / np.linalg.norm(seen, axis=1, keepdims=True)

    def dense(self, photo, of):
        """Features [D,rows,columns] of a whole photo."""
        k = of["side"] / max(photo.shape[:2])
        h, w = (max(1, round(v * k / of["cell"])) * of["cell"] for v in photo.shape[:2])
        mean, std = (np.array(self.manifest["image"][k], np.float32) for k in ("mean", "std"))
        x = (np.asarray(Image.fromarray(photo).resize((w, h), Image.BILINEAR), np.float32) / 255 - mean) / std
        return self.image.run([of["output"]], {"images": x.transpose(2, 0, 1)[None].astype(np.float32)})[0][0]

    @staticmethod
    def context(features, mask):
        """The unit mean of features under a mask, by the share of each cell that lies under it."""
        into = lambda n, cells: np.maximum(0, np.minimum(np.arange(1, n + 1)[None] * cells / n, np.arange(1, cells + 1)[:, None]) - np.maximum(np.arange(n)[None] * cells / n, np.arange(cells)[:, None]))
        share = into(mask.shape[0], features.shape[1]) @ mask @ into(mask.shape[1], features.shape[2]).T
        mean = (features * share).sum((1, 2))
        return mean / max(np.linalg.norm(mean), 1e-9)


def collect(data, split, masks=None, most=10**9):
    """[(group, key, label, square maker, the photo's labels)] of a split."""
    out = []
    if split == "choosing":
        images = os.path.join(data, "images")
        for name in cuts.SETS:
            for key, photo, found in cuts.things(images, name, "heldout"):
                labels = sorted({label for label, _ in found})
                out += [(name, key, label, (photo, m), labels) for label, m in found if label != "background"]
    else:
        for name in SCENES:
            folder = os.path.join(data, "scenes", name)
            if masks and os.path.isdir(os.path.join(masks, name)):
                folder = os.path.join(masks, name)
            if not os.path.isdir(os.path.join(folder, "masks")):
                continue
            found = list(cuts.scene(folder, 4))
            labels = sorted({label for _, _, t in found for label, _ in t})
            out += [(name, key, label, (photo, m), labels) for key, photo, t in found for label, m in t]
    return out[:most]


def scores(bundle, rows, everyday, margin=0.0, dim=0.0, context=True):
    """The words, each thing's score of each of them, and the score that a word must reach."""
    names = sorted({n for r in rows for n in r[4]} | set(everyday.words))
    text = bundle.texts(names)
    seen = bundle.things(rows, margin, dim, context)
    return names, seen @ text.T, bundle.floor(seen)


def evaluate(rows, everyday, scored, shift=0.0):
    """Figures of each group, of all things and of the mean of names, and what was said of each thing."""
    names, score, floor = scored
    at, groups, said = {n: i for i, n in enumerate(names)}, defaultdict(list), []
    for (group, key, label, _, labels), row, least in zip(rows, score, floor + shift):
        asked = list(dict.fromkeys(labels + everyday.words))
        good = np.array([everyday.may_be_said(label, w) for w in asked])
        s = row[[at[w] for w in asked]]
        found = row[at[label]] >= least
        figures = [found, good[s.argmax()], (s[~good] >= least).mean() if (~good).any() else 0.0]
        for name in (group, "all things", ("name", group if group in SCENES else "", label)):
            groups[name].append(figures)
        order = np.argsort(-s)[:6]
        said.append(f"{group} {key} {label}: {'FOUND' if found else '-'} {row[at[label]]:.2f} canon {least:.2f} | " + ", ".join(f"{asked[j]} {s[j]:.2f}" for j in order))
    groups["mean of names"] = [np.mean(groups.pop(g), 0) for g in [g for g in groups if isinstance(g, tuple)]]
    out = {}
    for group, v in groups.items():
        found, right, absent = np.array(v, float).mean(0)
        out[group] = {"count": len(v), "found": round(found, 3), "right": round(right, 3), "absent": round(absent, 4)}
    return out, said


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--bundle", required=True)
    ap.add_argument("--data", required=True)
    ap.add_argument("--wordnet", default="/usr/share/wordnet")
    ap.add_argument("--split", choices=["choosing", "reporting"], nargs="+", default=["choosing", "reporting"])
    ap.add_argument("--masks", help="folder with further labelled scenes")
    ap.add_argument("--image", help="another image tower than the bundle's")
    ap.add_argument("--margin", type=float)
    ap.add_argument("--cut", action="store_true", help="the cut alone, without the whole photo")
    ap.add_argument("--dim", type=float, default=0.0)
    ap.add_argument("--shift", type=float, nargs="+", default=[0.0], help="added to the canon's score, to see the trade")
    ap.add_argument("--over", type=float, help="another margin over the canon than the bundle's")
    ap.add_argument("--rivals", type=float, help="another share of the bundle's words than the bundle's that may fit a thing better")
    ap.add_argument("--detail", action="store_true")
    args = ap.parse_args()
    bundle = Bundle(args.bundle, image=args.image)
    bundle.manifest |= {k: v for k, v in (("margin", args.over), ("rivals", args.rivals)) if v is not None}
    margin = bundle.manifest["image"].get("crop_margin", 0.0) if args.margin is None else args.margin
    everyday = Everyday(WordNet(args.wordnet))
    print("everyday words", len(everyday.words))
    for split in args.split:
        rows = collect(args.data, split, args.masks)
        scored = scores(bundle, rows, everyday, margin, args.dim, not args.cut)
        for shift in args.shift:
            figures, said = evaluate(rows, everyday, scored, shift)
            if args.detail:
                print(*said, sep="\n")
            for group, v in figures.items():
                print(f"{split} shift {shift:+.2f} {group}: {json.dumps(v)}", flush=True)


if __name__ == "__main__":
    main()
