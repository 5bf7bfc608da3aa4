"""Which everyday words the towers of a bundle know: words.json beside them, and docs/words.md.

    python known_words.py --bundle ../../embedded --data ../../../../shared/data --pack PACK [--page ../../../docs/words.md]

Of each word of everyday.txt and known_words.txt, on photographs that no training saw: how many cut things and whole
photographs show it, in what share of them the server would select it (*found*), and in what share of the others (*absent*).
WordNet and everyday.txt say of what a word may be said; what may or may not be said counts for neither. Colours: the
dominant colour under the mask says what is true.
"""
import argparse
import json
import os

import numpy as np
import torch

import cuts
from colours import COLOURS, dominant_colour
from naming import HERE, Bundle, Everyday, collect
from pictures import decoded, letterbox
from wordnet import WordNet
from words_model import SIDE

NO_THINGS = ("colours", "places")  # kinds whose words are no rivals of a text in the server
FEWEST = 5  # things that a figure is trusted from
GOOD, POOR = (0.7, 0.03), (0.4, 0.1)  # found at least, absent at most; found under, absent over


def kinds():
    """{kind: words}: everyday.txt as things, then known_words.txt."""
    rows = [r.strip() for r in open(os.path.join(HERE, "everyday.txt")) if ":" not in r and not r.startswith("#")]
    out = {"things and stuff": [w.strip() for r in rows for w in r.split(",") if w.strip()]}
    for row in open(os.path.join(HERE, "known_words.txt")):
        if not row.startswith("#"):
            kind, words = row.split(":")
            out[kind] = [w.strip() for w in words.split(",")]
    done = set()
    return {k: [w for w in dict.fromkeys(v) if not (w in done or done.add(w))] for k, v in out.items()}


def judged(row):
    """A word's `trust`: by its cut things, or by whole photographs where too few show it."""
    n, found = (row["things"], row["things_found"]) if row["things"] >= FEWEST else (row["photographs"], row["photographs_found"])
    if n < FEWEST:
        return "unmeasured"
    if found >= GOOD[0] and row["absent"] <= GOOD[1]:
        return "good"
    return "poor" if found < POOR[0] or row["absent"] > POOR[1] else "fair"


def main():
    ap = argparse.ArgumentParser()
    for name in ["bundle", "data", "pack"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--wordnet", default="/usr/share/wordnet")
    ap.add_argument("--page")
    args = ap.parse_args()
    bundle, everyday = Bundle(args.bundle), Everyday(WordNet(args.wordnet))
    groups = kinds()
    words = [w for v in groups.values() for w in v]
    text = bundle.texts(words)

    # Things as the server sees them, and whole photographs in a black square.
    rows = collect(args.data, "choosing")
    held, packed = np.load(os.path.join(args.pack, "labelled.npz")), np.load(os.path.join(args.pack, "words.npz"))
    at = np.flatnonzero(held["held"])
    whole = [letterbox(decoded(held["blob"], held["offsets"], i), SIDE) for i in at]
    labels = [r[2] for r in rows] + [str(packed["words"][packed["own"][c]]) for c in held["label"][at]]
    seen = np.concatenate([bundle.things(rows, bundle.manifest["image"].get("crop_margin", 0.0)), bundle.pictures(whole)])
    named = [j for j, w in enumerate(words) if not any(w in groups[k] for k in NO_THINGS)]
    beats = seen @ text.T >= bundle.floor(seen, text[named])[:, None]
    thing = np.arange(len(labels)) < len(rows)

    # 1 true, 0 false, -1 open.
    may = {(a, w): everyday.may_be_said(a, w) for a in set(labels) for w in words}
    truth = np.array([[1 if a == w else -1 if may[a, w] else 0 for w in words] for a in labels])
    senses = lambda w: set(everyday.net.first.get(w, []))
    of_word = [senses(w) for w in words]
    for i, a in enumerate(labels):
        # A thing is what its label is a kind of; what may be more than that is open.
        known = senses(a).union(*[everyday.net.lineage(o) for o in senses(a)])
        for j in range(len(words)):
            if truth[i, j] == -1 and of_word[j] & known:
                truth[i, j] = 1
    # The word "orange" stands for the fruit.
    colours = {k: words.index(w) for k, w in enumerate(COLOURS) if w in groups["colours"]}
    at = list(colours.values())
    truth[:, at] = -1
    for i, r in enumerate(rows):
        photo, mask = (torch.from_numpy(v.copy()) for v in r[3])
        said = dominant_colour(photo.permute(2, 0, 1)[None].float() / 255, mask[None, None].float())[0]
        truth[i, at] = said[list(colours)].numpy()

    share = lambda v: round(float(v.mean()), 3) if len(v) else None
    out = []
    for j, word in enumerate(words):
        shows, lacks = truth[:, j] == 1, truth[:, j] == 0
        row = {"word": word, "things": int((shows & thing).sum()), "things_found": share(beats[shows & thing, j]),
               "photographs": int((shows & ~thing).sum()), "photographs_found": share(beats[shows & ~thing, j]), "absent": share(beats[lacks, j]) or 0.0}
        out.append({**row, "trust": judged(row), **({} if j in named else {"rival": False})})
    with open(os.path.join(args.bundle, "words.json"), "w") as f:
        f.write("[\n" + ",\n".join(json.dumps(r) for r in out) + "\n]\n")
    count = {t: sum(r["trust"] == t for r in out) for t in ("good", "fair", "poor", "unmeasured")}
    print(len(out), "words", count)
    if args.page:
        page(args.page, {k: [r for r in out if r["word"] in v] for k, v in groups.items()}, count, len(rows), len(whole))


def page(path, groups, count, things, photographs):
    of_100 = lambda v: float(np.float32(100) * np.float32(v))  # as the server has it
    percent = lambda v: "-" if v is None else f"{of_100(v):.0f} %"
    lines = [
        "# Words that the embedded bundle knows", "",
        f"Measured on {things} things that were cut out along their labelled outlines and {photographs} whole photographs; no training saw them.",
        "*Found*: of those that show it, the share for which the server would select it. *Absent*: of those that do not show it,",
        f"the share for which it does so, too. *Good*: found in at least {GOOD[0]:.0%}, absent in at most {GOOD[1]:.0%}. *Poor*: found in under",
        f"{POOR[0]:.0%}, or absent in over {POOR[1]:.0%}. *Unmeasured*: fewer than {FEWEST} things and photographs show it. By things where there",
        "are enough, else by photographs. The server says the same in `GET /v1/models`, field `words`.", "",
        "The photographs are of the sets that the towers were trained on: in your rooms expect less. The bare name and a sentence (\"a photo of a",
        'X") find the same things. A word that is not on this page is unmeasured, too. Made by `models/training/semantics/known_words.py`.', "",
        ", ".join(f"{n} {t}" for t, n in count.items()) + ".", "",
    ]
    for kind, rows in groups.items():
        lines += [f"## {kind.capitalize()}", "", "| word | trust | things, found | photographs, found | absent |", "|---|---|---|---|---|"]
        order = {t: i for i, t in enumerate(count)}
        for r in sorted(rows, key=lambda r: (order[r["trust"]], r["word"])):
            pair = lambda n: f"{r[n]}, {percent(r[n + '_found'])}" if r[n] else "-"
            lines.append(f"| {r['word']} | {r['trust']} | {pair('things')} | {pair('photographs')} | {of_100(r['absent']):.1f} % |")
        lines.append("")
    open(path, "w").write("\n".join(lines).rstrip() + "\n")


if __name__ == "__main__":
    main()
