"""Teaches the text tower that a name in a sentence is that name: "a photo of a mug", "the mug on the table", "mugs".

    python train_forms.py pack --data ../../../../shared/data --wordnet DICT --bundle ../../embedded --out PACK     # forms.npz
    python train_forms.py train --pack PACK --out OUT --seconds S                                                   # forms.pt

The tower that training begins with is the teacher: of a name alone, and of sentences that are no form of a name (captions, glosses),
it must stay what it was, so that image towers keep their words. A form of a name goes to the name; with a colour
or a material before it, to the sum of the name and of that phrase. A tenth of the names is held out.
"""
import argparse
import json
import math
import os
import tarfile
import time

import numpy as np
import torch
import torch.nn.functional as F

from words_model import CONTEXT, TextTower

FORMS = [
    "a {a}", "the {a}", "{s}", "the {s}", "a photo of a {a}", "a photo of the {a}", "a picture of a {a}", "my {a}", "this {a}", "that {a}", "one {a}", "some {s}", "two {s}",
    "all the {s}", "{a} on the table", "the {a} on the table", "the {a} on the floor", "a {a} on the wall", "the {a} in the room", "the {a} next to the window",
    "the {a} in the corner", "where is the {a}?", "find the {a}", "show me the {a}", "select the {a}", "a small {a}", "a big {a}", "the large {a}", "an old {a}", "a new {a}",
]
QUALIFIED = ["{q} {a}", "a {q} {a}", "the {q} {a}", "the {q} {a} on the table", "a photo of a {q} {a}", "{q} {s}"]
COLOUR = 0.35  # how much of the qualified phrase is in the target beside the name
HELD = 10  # one name in so many is kept out
KIND = "cuda" if torch.cuda.is_available() else "cpu"


def plural(name):
    if name.endswith(("s", "x", "ch", "sh")):
        return name + ("" if name.endswith("s") and not name.endswith("ss") else "es")
    return name[:-1] + "ies" if name.endswith("y") and name[-2:-1] not in "aeiou" else name + "s"


def pack(args):
    from naming import Bundle
    from pooled_masks import weights
    from prepare import COLOURS
    from wordnet import BODILY, WordNet

    net, rng = WordNet(args.wordnet), np.random.default_rng(4)
    bundle = Bundle(args.bundle)
    z = np.load(os.path.join(args.out, "words.npz"))
    names = [str(w) for w in z["words"]]
    names += [w for w, o in net.first.items() if net.kind[o[0]] in BODILY and len(w) < 22 and w.count(" ") < 3 and w.isascii() and not any(c.isdigit() for c in w)]
    names = list(dict.fromkeys(names))[:24000]
    qualities = [*COLOURS, "wooden", "metal", "plastic", "glass", "paper", "stone", "leather", "round", "empty", "open", "striped"]
    ids = lambda t: bundle.tokens.encode(t.lower()).ids[:CONTEXT]
    phrases, target, also = [], [], []  # tokens; name; phrase whose own meaning is mixed in, or -1
    for i, n in enumerate(names):
        phrases.append(n), target.append(i), also.append(-1)
    for i, n in enumerate(names):
        own = i < len(z["words"])
        for k in rng.choice(len(FORMS), 10 if own else 4, replace=False):
            phrases.append(FORMS[k].format(a=n, s=plural(n))), target.append(i), also.append(-1)
        for k in rng.choice(len(QUALIFIED), 4 if own else 1, replace=False):
            q = str(rng.choice(qualities))
            phrases.append(QUALIFIED[k].format(a=n, s=plural(n), q=q)), target.append(i), also.append(len(phrases) - 1)
    with tarfile.open(os.path.join(args.data, "images", "flickr8k_1000.tar")) as tar:
        captions = [c for v in json.load(tar.extractfile([n for n in tar.getnames() if n.endswith("captions.json")][0])).values() for c in v]
    glosses = [g[:120] for o, (_, g, _) in net.synsets.items() if net.kind[o] in BODILY]
    keep = [*bundle.manifest["canon"], *captions, *[str(g) for g in rng.choice(glosses, 8000, replace=False)], *qualities]
    for t in keep:
        phrases.append(t), target.append(-1), also.append(-1)
    table = np.zeros((len(phrases), CONTEXT), np.uint16)
    for i, t in enumerate(phrases):
        row = ids(t)
        table[i, : len(row)] = row
    state = weights(os.path.join(args.bundle, bundle.manifest["text"]["file"]))
    state["turn"] = state.pop(".weight")
    np.savez_compressed(os.path.join(args.out, "forms.npz"), ids=table, target=np.array(target), also=np.array(also), names=len(names), own=len(z["words"]),
                        **{"w." + k: v.numpy().astype(np.float16) for k, v in state.items()})
    tower = tower_of(np.load(os.path.join(args.out, "forms.npz")))
    some = np.arange(0, len(names), 997)
    with torch.no_grad():
        got = tower(torch.from_numpy(table[some].astype(np.int64))).numpy()
    print("phrases", len(phrases), "names", len(names), "difference from the bundle's tower", np.abs(got - bundle.texts([names[i] for i in some])).max())


def tower_of(z):
    tower = TextTower()
    state = {k[2:]: torch.from_numpy(z[k].astype(np.float32)) for k in z.files if k.startswith("w.")}
    missing = tower.load_state_dict(state, strict=False)
    if missing.missing_keys or missing.unexpected_keys:
        raise SystemExit(f"not the weights of this tower: {missing}")
    return tower.eval()


def train(args):
    begin, device = time.time(), torch.device(KIND)
    torch.manual_seed(args.seed)
    z = np.load(os.path.join(args.pack, "forms.npz"))
    ids = torch.from_numpy(z["ids"].astype(np.int64)).to(device)
    target, also, n, own = torch.from_numpy(z["target"]).to(device), torch.from_numpy(z["also"]).to(device), int(z["names"]), int(z["own"])
    first, tower = tower_of(z).to(device).requires_grad_(False), tower_of(z).to(device)
    trim = lambda t: t[:, : max(1, int((t > 0).sum(1).max()))]
    with torch.no_grad():
        said = torch.cat([first(trim(t)) for t in ids.split(2048)])
    want = said.clone()
    form = target >= 0
    want[form] = said[target[form]]
    mixed = also >= 0
    want[mixed] = F.normalize(want[mixed] + COLOUR * said[also[mixed]], dim=-1)
    held = form & (target % HELD == 3)
    is_name = torch.arange(len(ids), device=device) < n
    use = torch.nonzero(~held | is_name)[:, 0]
    weight = torch.where(is_name[use], 3.0, 1.0) * torch.where((target[use] >= 0) & (target[use] < own), 2.0, 1.0) * torch.where(form[use], 1.0, 3.0)
    test = torch.nonzero(held & ~is_name & ~mixed)[:, 0]
    test = test[:: max(1, len(test) // 4000)]

    @torch.no_grad()
    def measured(tag):
        tower.eval()
        f = torch.cat([tower(trim(t)) for t in ids[test].split(1024)])
        plain = torch.cat([tower(trim(t)) for t in ids[:own].split(1024)])
        among = f @ said[:n].T
        top = (among.argmax(1) == target[test]).float().mean()
        print(f"[{time.time() - begin:.0f}s] {tag}: forms of held-out names: cosine to the name {float((f * want[test]).sum(1).mean()):.4f}, it is the nearest of {n} {100 * float(top):.1f} %; "
              f"names alone: cosine to before mean {float((plain * said[:own]).sum(1).mean()):.4f}, least {float((plain * said[:own]).sum(1).min()):.3f}", flush=True)

    def save():
        path = os.path.join(args.out, "forms.pt")
        torch.save({k: v.half().cpu() for k, v in tower.state_dict().items()}, path + ".tmp")
        os.replace(path + ".tmp", path)

    measured("before")
    opt = torch.optim.AdamW(tower.parameters(), lr=3e-4, weight_decay=0.0, betas=(0.9, 0.99))
    step, start = 0, time.time()
    while (t := (time.time() - start) / max(1.0, args.seconds - (start - begin) - 3)) < 1:
        for g in opt.param_groups:
            g["lr"] = 3e-4 * min(1, (step + 1) / 100) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * t)))
        pick = use[torch.multinomial(weight, args.batch, True)]
        tower.train()
        f = tower(trim(ids[pick]))
        cos = (f * want[pick]).sum(1)
        # Nearer to its own name than to others: among the names of the batch.
        logits = 30 * f @ want[pick].T
        same = (target[pick][:, None] == target[pick][None]) & (target[pick] >= 0)[:, None] & ~torch.eye(len(pick), dtype=torch.bool, device=device)
        loss = 10 * (1 - cos).mean() + 0.3 * F.cross_entropy(logits.masked_fill(same, -1e4), torch.arange(len(pick), device=device))
        opt.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(tower.parameters(), 1.0)
        opt.step()
        step += 1
        if step % 500 == 0:
            measured(f"step {step}")
            save()
    save()
    measured(f"end, step {step}")


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("what", choices=["pack", "train"])
    for name in ["data", "wordnet", "bundle", "pack"]:
        ap.add_argument("--" + name)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, default=120)
    ap.add_argument("--batch", type=int, default=1024)
    ap.add_argument("--seed", type=int, default=40)
    args = ap.parse_args()
    {"pack": pack, "train": train}[args.what](args)


if __name__ == "__main__":
    main()
