"""Distils MiniLM into the text tower, then into the space that the image tower has learnt.

    python train_text.py --pack PACK --out OUT --seconds S --space OUT/space.pt --more T

First MiniLM's own embeddings of words, phrases, captions and glosses; when `space.pt` (from
train_words.py) is there (it waits for it), the turned space, with the canon phrases where the image tower put them.
"""
import argparse
import json
import math
import os
import time

import numpy as np
import torch
import torch.nn.functional as F

from minilm import MiniLM, embed_all, ragged
from words_model import CONTEXT, TextTower


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--seconds", type=float, required=True)
    ap.add_argument("--space", required=True)
    ap.add_argument("--more", type=float, default=80)
    ap.add_argument("--lr", type=float, default=1.5e-3)
    ap.add_argument("--init", help="text.pt of an earlier run")
    args = ap.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(7)
    torch.backends.cuda.matmul.allow_tf32 = True
    z = np.load(os.path.join(args.pack, "phrases.npz"))
    get = lambda n: torch.from_numpy(z[n].astype(np.int64)).to(device)
    theirs, theirs_at, ours, ours_at = get("theirs"), get("theirs_at"), get("ours"), get("ours_at")
    target = embed_all(MiniLM(os.path.join(args.pack, "minilm.npz"), device), theirs, theirs_at, device)
    count, named = len(target), int(z["named"])
    print("phrases", count, flush=True)
    # Rows 0..2 are the canon; the next `named` are the words that pictures are trained with.
    held = torch.arange(count, device=device) % 50 == 49
    held[: named + 3] = False
    rows = torch.arange(count, device=device)[~held]
    weight = torch.ones(len(rows), device=device)
    weight[: named + 3] = 16.0
    net = TextTower().to(device)
    if args.init:
        net.load_state_dict({k: v.float() for k, v in torch.load(args.init, map_location=device).items()})
    ema = {k: v.clone() for k, v in net.state_dict().items()}
    opt = torch.optim.AdamW(net.parameters(), lr=args.lr, weight_decay=0.02, betas=(0.9, 0.98))
    begin, step, stage, canon = time.time(), 0, 0, None
    log = open(os.path.join(args.out, "text.jsonl"), "w")

    def check(tag):
        keep = {k: v.clone() for k, v in net.state_dict().items()}
        net.load_state_dict({k: ema[k] if k in ema and k not in ("centre", "turn") else v for k, v in keep.items()})
        net.eval()
        with torch.no_grad():
            out = {}
            for name, r in [("held", torch.arange(count, device=device)[held]), ("named", torch.arange(3, named + 3, device=device))]:
                ids, _ = ragged(ours, ours_at, r, CONTEXT, device)
                a = torch.cat([net(x) for x in ids.split(4096)])
                b = F.normalize((target[r] - net.centre) @ net.turn.T, dim=-1)
                near = (a @ b.T).argmax(1) == torch.arange(len(r), device=device)
                out[name] = [round(float((a * b).sum(1).mean()), 4), round(float(near.float().mean()), 4)]
        print(tag, "cosine, own is nearest:", json.dumps(out), flush=True)
        log.write(json.dumps({"step": step, "tag": tag, **out}) + "\n")
        log.flush()
        net.load_state_dict(keep)
        net.train()

    while True:
        now = time.time() - begin
        if stage == 0 and now > args.seconds and os.path.exists(args.space):
            check("own space")
            space = torch.load(args.space, map_location=device)
            net.centre.copy_(space["centre"])
            net.turn.copy_(space["turn"])
            canon = F.normalize(space["canon"], dim=-1)
            stage, began = 1, now
            weight[:3] = 200.0
        if stage == 0 and now > args.seconds:
            time.sleep(0.5)
            continue
        if stage == 1 and now > began + args.more:
            break
        if stage == 0:
            share = min(now / args.seconds, 1.0)
            lr = args.lr * min(1, (step + 1) / 300) * (0.1 + 0.9 * (0.5 + 0.5 * math.cos(math.pi * share)))
        else:
            lr = args.lr * (0.6 if args.init else 0.25) * min(1, (step + 1) / 300) * (0.5 + 0.5 * math.cos(math.pi * (now - began) / args.more))
        for group in opt.param_groups:
            group["lr"] = lr
        pick = rows[torch.multinomial(weight, 2048, True)]
        ids, _ = ragged(ours, ours_at, pick, CONTEXT, device)
        with torch.autocast(device.type, dtype=torch.bfloat16):
            m = net.teacher_space(ids)
        if stage == 0:
            got, want = m, target[pick]
        else:
            got = F.normalize((m - net.centre) @ net.turn.T, dim=-1)
            want = F.normalize((target[pick] - net.centre) @ net.turn.T, dim=-1)
            want = torch.where((pick < 3)[:, None], canon[pick.clamp(max=2)], want)
        loss = (1 - (got * want).sum(1)).mean()
        sim = want @ want.T
        loss = loss + 4 * ((got @ got.T - sim) ** 2).mean() + 0.05 * F.cross_entropy(got @ want.T * 30, torch.arange(len(pick), device=device))
        opt.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        opt.step()
        with torch.no_grad():
            for k, v in net.state_dict().items():
                ema[k].lerp_(v, 1 - min(0.998, (step + 1) / (step + 10)))
        step += 1
        if step % 1000 == 0:
            print(f"text step {step} {now:.0f}s loss {loss.item():.4f}", flush=True)
    check("end")
    ema["centre"], ema["turn"] = net.centre, net.turn
    torch.save({k: v.half().cpu() for k, v in ema.items()}, os.path.join(args.out, "text.pt"))
    print("text trained", step, flush=True)


if __name__ == "__main__":
    main()
