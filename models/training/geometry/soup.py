"""Mixes the weights of several runs and judges each mix: which mean of weights is best?

    python soup.py --start start.pt --runs OUT OUT ... --scenes SCENES --data DATA --out OUT --part I/N
    python soup.py --start start.pt --runs OUT OUT ... --out OUT --pick 2

The first form judges its part of the mixes (one process for each GPU) and writes `soup-I.jsonl`; the second takes the
best ones by the scenes that choose and the captures held out, and writes their weights.
"""
import argparse
import glob
import io
import itertools
import json
import os

import torch

from train import write_parts

START_SHARES = (0.0, 0.4)


def weights_of(run):
    """The last weights that a run wrote, in parts."""
    parts = sorted(glob.glob(os.path.join(run, "weights-*")))
    return torch.load(io.BytesIO(b"".join(open(p, "rb").read() for p in parts)), map_location="cpu")


def mixes(count, start_shares=START_SHARES):
    """Shares of the start and of each run: the start, each run, each pair, all; the start in it, too."""
    groups = [c for n in (1, 2, count) for c in itertools.combinations(range(count), n)]
    found = [[1.0] + [0.0] * count]
    for share in start_shares:
        for group in dict.fromkeys(groups):
            found.append([share] + [(1 - share) / len(group) if i in group else 0.0 for i in range(count)])
    return found


def mixed(states, shares):
    return {k: sum(w * s[k].float() for w, s in zip(shares, states) if w) for k in states[0]}


def judged(args, states):
    from judge import Judge
    from model import GeometryNet

    part, parts = (int(x) for x in args.part.split("/"))
    device = torch.device("cuda", part if args.gpu is None else args.gpu) if torch.cuda.is_available() else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    held_out = [os.path.dirname(p) for p in sorted(glob.glob(os.path.join(args.data, "*", "cameras.json"))) if '"held_out": true' in open(p).read(400)]
    judge = Judge(args.scenes, held_out, device, args.views, args.side)
    net = GeometryNet().to(device).eval()
    with open(os.path.join(args.out, f"soup-{part}.jsonl"), "w") as file:
        for shares in mixes(len(args.runs), args.start_shares)[part::parts]:
            net.load_state_dict(mixed(states, shares))
            uses, scenes = judge.figures(net, args.every)
            line = json.dumps({"shares": shares, "uses": uses, "scenes": scenes})
            file.write(line + "\n")
            file.flush()
            print(line[:400], flush=True)


def score(row):
    """PSNR and SSIM of the groups; a hundredth of SSIM is worth a tenth of a dB."""
    groups = [figures for use, figures in row["uses"].items() if use.startswith(("choose/", "held_out/"))]
    return sum(g[0] + 10 * g[1] for g in groups) / len(groups)


def picked(args, states):
    rows = [json.loads(line) for path in glob.glob(os.path.join(args.out, "soup-*.jsonl")) for line in open(path)]
    rows.sort(key=score, reverse=True)
    for row in rows:
        print(round(score(row), 3), row["shares"], {k: v[:3] for k, v in row["uses"].items()})
    for n, row in enumerate(rows[: args.pick]):
        write_parts(args.out, f"best{n}", {k: v.half() for k, v in mixed(states, row["shares"]).items()}, 0)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--start", required=True)
    ap.add_argument("--runs", nargs="+", required=True, help="folders that train.py wrote")
    ap.add_argument("--out", required=True)
    ap.add_argument("--scenes")
    ap.add_argument("--data")
    ap.add_argument("--every", type=int, default=1)
    ap.add_argument("--views", type=int, nargs="*", default=[2], help="photos of the sets that are judged")
    ap.add_argument("--side", type=int, default=256, help="side of the network's inputs")
    ap.add_argument("--start-shares", type=float, nargs="*", default=START_SHARES)
    ap.add_argument("--gpu", type=int, help="device, where it is not the number of the part")
    ap.add_argument("--part", help="I/N: this process judges every Nth mix")
    ap.add_argument("--pick", type=int, default=0)
    args = ap.parse_args()
    torch.backends.cudnn.allow_tf32 = True
    states = [torch.load(args.start, map_location="cpu"), *(weights_of(run) for run in args.runs)]
    os.makedirs(args.out, exist_ok=True)
    if args.part:
        judged(args, states)
    if args.pick:
        picked(args, states)


if __name__ == "__main__":
    main()
