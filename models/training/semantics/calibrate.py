"""What the bundle's margin and tau should be: how often a text is right by its score, and what nonsense finds.

    python calibrate.py --pack PACK --bundle ../../embedded [--limit 400]

On the judged things of pooled_judge.py, as the server sees them (crop and context of the exported tower, texts of the text
tower). *Margin*: found and absent of each. *Score*: of each photograph the names of its things are asked, and as many words that may
be said of none; the answer is the thing with the best score, and it is right where the word may be said of it. The calibration
error of an answer that is over the margin: mean of |score - share that is right| over five ranges of the score, by their answers.
*Nonsense*: 200 strings of 4 to 9 random letters asked of photographs of three things and more, and of 20 random things.
"""
import argparse
import json
import os
import random

import numpy as np
import torch

from naming import Bundle
from pooled_judge import Judge, OnnxTower

unit = lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True)


def answers(judge, lead, kind, rng):
    """Lead of each answer, and whether it is right."""
    photo, label, state = judge.photo.numpy(), judge.label.numpy(), judge.state.numpy()
    out = []
    for p in np.unique(photo[judge.kinds[kind].numpy()]):
        rows = np.flatnonzero(photo == p)
        own = sorted(set(label[rows]))
        absent = np.flatnonzero((state[rows] == 0).all(0))
        for w in own + list(rng.choice(absent, min(len(absent), len(own)), replace=False)):
            best = rows[lead[rows, w].argmax()]
            out.append((lead[best, w], state[best, w] == 1))
    return np.array(out, float).T


def error(score, right):
    bins = np.clip(((score - 0.5) * 10).astype(int), 0, 4)
    parts = [(bins == b) for b in range(5) if (bins == b).any()]
    return sum(m.sum() * abs(score[m].mean() - right[m].mean()) for m in parts) / len(score)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--bundle", required=True)
    ap.add_argument("--limit", type=int, default=0)
    args = ap.parse_args()
    bundle = Bundle(args.bundle)
    image, margin = bundle.manifest["image"], bundle.manifest.get("margin", 0.0)
    judge = Judge(args.pack, torch.device("cpu"), (image["dense"]["side"],), args.limit)
    seen = judge.embeddings(OnnxTower(os.path.join(args.bundle, image["file"])))
    things = unit(sum(v.numpy() for v in seen.values()))
    texts = json.load(open(os.path.join(args.pack, "judge.json")))["texts"]
    canon = (things @ unit(bundle.texts(bundle.manifest["canon"])).T).max(1, keepdims=True)
    lead = things @ unit(bundle.texts(texts)).T - canon
    mine, state = lead[np.arange(len(lead)), judge.label.numpy()], judge.state.numpy()
    for kind in ("held", "open", "scenes"):
        rows = judge.kinds[kind].numpy()
        for g in (0.0, -0.01, -0.015, -0.02, -0.03):
            print(f"{kind} margin {g:+.3f}: found {100 * (mine[rows] >= g).mean():.1f}, absent {100 * (lead[rows][state[rows] == 0] >= g).mean():.2f} %")
        s, right = answers(judge, lead, kind, np.random.default_rng(0))
        for tau in (8, 10, 12, 15, 20, 30):
            score = 1 / (1 + np.exp(-tau * (s - margin)))
            print(f"{kind} tau {tau}: calibration error {error(score[score >= 0.5], right[score >= 0.5]):.3f} of {(score >= 0.5).sum()} answers")
    rng = random.Random(11)
    words = ["".join(rng.choice("abcdefghijklmnopqrstuvwxyz") for _ in range(rng.randint(4, 9))) for _ in range(200)]
    pieces = [len(bundle.tokens.encode(w, add_special_tokens=False).ids) for w in words]
    silent = np.array([n > 1 and len(w) / n < bundle.manifest["text"].get("piece_letters", 0) for w, n in zip(words, pieces)])
    hit = things @ unit(bundle.texts(words)).T - canon >= margin
    photo = judge.photo.numpy()
    sets = [r for r in (np.flatnonzero(photo == p) for p in np.unique(photo)) if len(r) >= 3]
    for name, groups in (("photographs", sets), ("20 things", [rng.sample(range(len(hit)), 20) for _ in range(50)])):
        found = np.array([hit[r].any(0) for r in groups])
        print(f"nonsense, {name}: found {100 * found.mean():.1f} %, without words in short pieces {100 * (found & ~silent).mean():.1f} %")


if __name__ == "__main__":
    main()
