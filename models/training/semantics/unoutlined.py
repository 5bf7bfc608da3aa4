"""How well towers know things whose names no training saw under an outline: Tux Paint's photographic stamps.

    python unoutlined.py --bundle ../../embedded --pack PACK --stamps /usr/share/tuxpaint/stamps [--image a.onnx b.onnx]

A stamp is cut by its own alpha (`stamps.txt`: what each one shows). Its name is *unoutlined* where no drawn thing, render or box
of the pack is called so or is a kind of it; class-labelled photographs may be. Printed for the bundle's tower, then for each of
--image with the difference to it, mean over names and standard error: found (the name beats every canon phrase), the name's margin
over the canon, right (best among the everyday words), the share of false everyday words that beat the canon, and what is found at
the canon where that share is the bundle's.
"""
import argparse
import os

import numpy as np
from PIL import Image

import cuts
from naming import HERE, Bundle, Everyday
from wordnet import WordNet


def stamps(folder):
    """(name, photo [h,w,3], mask [h,w]) of each stamp of stamps.txt."""
    for row in open(os.path.join(HERE, "stamps.txt")):
        if not row.startswith("#"):
            name, files = row.strip().split(": ")
            for file in files.split(", "):
                a = np.asarray(Image.open(os.path.join(folder, file + ".png")).convert("RGBA"))
                yield name, a[..., :3], a[..., 3] > 127


class Outlined:
    """Whether a name is true of a class that training showed under an outline, in a render or in a box."""

    def __init__(self, pack, net):
        at = lambda n: np.load(os.path.join(pack, n))
        z, shapes, wild = at("words.npz"), at("things.npz"), at("wild.npz")["found"]
        of = {str(n): int(c) for n, c in zip(z["thing_names"], z["things"])}
        drawn = at("drawn.npz")["thing"][:, 2]
        seen = {*drawn[drawn >= 0].tolist(), *(of[str(shapes["names"][n])] for n in shapes["name"]), *wild[wild[:, 2] > 0.55, 1].astype(int).tolist()}
        self.index, self.truth, self.seen = {str(w): i for i, w in enumerate(z["words"])}, z["truth"], sorted(seen)
        self.net, self.synsets = net, {net.find(str(z["words"][z["own"][c]])) for c in seen} - {None}

    def __call__(self, name):
        o = self.net.find(name)
        true = name in self.index and (self.truth[self.seen, self.index[name]] == 1).any()
        return bool(true or o is not None and any(o == s or o in self.net.lineage(s) for s in self.synsets))


def main():
    ap = argparse.ArgumentParser()
    for name in ["bundle", "pack", "stamps"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--wordnet", default="/usr/share/wordnet")
    ap.add_argument("--image", nargs="*", default=[], help="other image towers than the bundle's")
    args = ap.parse_args()
    net = WordNet(args.wordnet)
    everyday, outlined = Everyday(net), Outlined(args.pack, net)
    rows = [r for r in stamps(args.stamps) if not outlined(r[0])]
    squares, labels = [cuts.square(photo, mask) for _, photo, mask in rows], np.array([r[0] for r in rows])
    names = sorted(set(labels))
    print(len(rows), "stamps,", len(names), "names")
    first = Bundle(args.bundle)
    words, own, canon = first.texts(everyday.words), first.texts(list(labels)), first.texts(first.manifest["canon"])
    may = np.array([[everyday.may_be_said(label, w) for w in everyday.words] for label in labels])
    mean = lambda v: np.array([v[labels == n].mean() for n in names])
    base = share = None
    for path in [None, *args.image]:
        seen = Bundle(args.bundle, image=path).pictures(squares)
        floor = (seen @ canon.T).max(1)
        said, mine = seen @ words.T - floor[:, None], (seen * own).sum(1) - floor
        false = said[~may]
        share = (false >= 0).mean() if share is None else share
        best = np.maximum(mine, np.where(may, said, -9).max(1)) >= np.where(may, -9, said).max(1)
        figures = [mean(v.astype(float)) for v in (mine >= 0, mine, best, mine >= np.quantile(false, 1 - share))]
        base = base or figures
        cell = lambda v, b: f"{v.mean():.3f} ({(v - b).mean():+.3f} se {(v - b).std(ddof=1) / len(v) ** 0.5:.3f})"
        what = zip(("found", "margin", "right", "found at the bundle's absent share"), figures, base)
        print(path or "bundle", *(f"| {n} {cell(v, b)}" for n, v, b in what), f"| absent {(false >= 0).mean():.4f}", flush=True)


if __name__ == "__main__":
    main()
