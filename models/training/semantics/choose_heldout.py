"""Chooses the meshes kept out of training: evaluation scenes are built from these alone.

    python choose_heldout.py --data ../../../../shared/data > heldout_meshes.txt

For each noun of KEPT_NOUNS one *family* is drawn by the seed: meshes of one source folder with the
same triangles and proportions are one thing in several colours, and leave training together. Such
a noun stays in training through its other meshes. The nouns of ALONE have one family each, so that
no rendered example of the word is left to learn from at all.
"""
import argparse

import numpy as np

from names import plain_name, read_index

SEED = 20260
KEPT_NOUNS = [  # on a table
    "apple", "banana", "book", "boat", "bottle", "bowl", "cactus", "car", "carrot", "cheese", "coffee mug", "crate",
    "cup", "cutting board", "donut", "frying pan", "hamburger", "jar", "ketchup bottle", "lemon", "milk carton",
    "mustard bottle", "onion", "orange", "pear", "picture frame", "pillow", "plate", "pot", "potted plant", "pumpkin",
    "race car", "remote control", "sandwich", "scissors", "soda can", "stapler", "teacup", "tin can", "tomato",
    "tractor", "wine bottle",
    # on a floor
    "armchair", "bed", "cabinet", "chair", "coffee table", "refrigerator", "round table", "sofa", "shelf", "stool", "stove",
]
ALONE = ["broccoli", "guitar", "hammer", "headphones", "keyboard", "pineapple", "pizza", "rabbit", "table lamp",
         "television", "vase"]
PARTS = ("half", "slice", "chopped", "pieces", "lid", "trash", "sink", "empty", "open", "crushed", "decorated")


def alike(a, b):
    """Same folder, triangles and (to 2 %) proportions: one thing, whatever its colour."""
    p, q = ([x / max(e["extent"]) for x in sorted(e["extent"])] for e in (a, b))
    return (a["file"].split("/")[0] == b["file"].split("/")[0] and a["triangles"] == b["triangles"]
            and max(abs(x - y) for x, y in zip(p, q)) <= 0.02)


def families(entries):
    groups = []
    for entry in entries:
        for group in groups:
            if any(alike(entry, other) for other in group):
                group.append(entry)
                break
        else:
            groups.append([entry])
    return groups


def choose(index):
    rng = np.random.default_rng(SEED)
    chosen = []
    for noun in KEPT_NOUNS + ALONE:
        groups = families([e for e in index if plain_name(e) == noun])
        whole = [g for g in groups if not any(p in e["file"] for e in g for p in PARTS)]
        if not whole or (noun in KEPT_NOUNS and len(groups) < 2):
            raise SystemExit(f"{noun}: {len(groups)} families, {len(whole)} of them whole things")
        chosen += [e["file"] for e in whole[rng.integers(len(whole))]]
    return chosen


if __name__ == "__main__":
    ap = argparse.ArgumentParser()
    ap.add_argument("--data", required=True)
    print("\n".join(sorted(choose(read_index(ap.parse_args().data)))))
