"""An image tower between two: fine-tuned weights that keep more of what the first ones knew.

    python blend.py --first ../../embedded/image_tower.onnx --words real.pt --share 0.5 --out image_tower.onnx

Both are brought to the form with batch norm folded; every number goes `share` of the way from the first to the
second (Wortsman et al., "Robust fine-tuning of zero-shot models"). Written in 8 bits, as export.py does.
"""
import argparse

import torch

from export import fold, state, write
from train_real import folded
from words_model import SIDE, ImageTower


@torch.no_grad()
def main():
    ap = argparse.ArgumentParser()
    for name in ["first", "words", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--share", type=float, required=True)
    args = ap.parse_args()
    torch.manual_seed(0)
    tower = ImageTower()
    tower.load_state_dict(state(args.words, "tower."))
    tower = fold(tower.eval())
    first, now = folded(args.first), tower.state_dict()
    for name in [k for k in now if now[k].is_floating_point()]:
        now[name] = first[name] + args.share * (now[name] - first[name])
    tower.load_state_dict(now)
    write(tower, (torch.rand(2, 3, SIDE, SIDE) * 2 - 1,), args.out, ["images"], ["embeddings"], {"images": {0: "batch"}, "embeddings": {0: "batch"}})


if __name__ == "__main__":
    main()
