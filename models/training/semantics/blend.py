"""An image tower between two: fine-tuned weights that keep more of what the first ones knew.

    python blend.py --first ../../embedded/image_tower.onnx --words a.pt [b.pt] --share 0.5 [--lower 0.1] --out image_tower.onnx

All are brought to the form with batch norm folded; every number goes `share` of the way from the first to the
mean of the others (Wortsman et al., "Robust fine-tuning of zero-shot models" and "Model soups"). `--lower` takes
that share of what points at the canon phrases of --bundle out of the last matrix: words then beat them more easily.
Written in 8 bits, as export.py does.
"""
import argparse

import torch

from export import state, write
from naming import Bundle
from towers import fold, folded
from words_model import SIDE, ImageTower


@torch.no_grad()
def main():
    ap = argparse.ArgumentParser()
    for name in ["first", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--words", nargs="+", required=True)
    ap.add_argument("--share", type=float, required=True)
    ap.add_argument("--lower", type=float, default=0.0)
    ap.add_argument("--bundle", default="../../embedded")
    args = ap.parse_args()
    torch.manual_seed(0)
    first, mean = folded(args.first), {}
    for path in args.words:
        tower = ImageTower()
        tower.load_state_dict(state(path, "tower."))
        for k, v in fold(tower.eval()).state_dict().items():
            mean[k] = mean.get(k, 0) + v / len(args.words)
    now = {k: first[k] + args.share * (v - first[k]) for k, v in mean.items()}
    if args.lower:
        bundle = Bundle(args.bundle)
        canon = torch.from_numpy(bundle.texts(bundle.manifest["canon"])).mean(0)
        canon = canon / canon.norm()
        for k in ("out.weight", "out.bias"):
            along = canon @ now[k]
            now[k] = now[k] - args.lower * (torch.outer(canon, along) if along.ndim else canon * along)
    tower = fold(ImageTower().eval())
    tower.load_state_dict(now)
    write(tower, (torch.rand(2, 3, SIDE, SIDE) * 2 - 1,), args.out, ["images"], ["embeddings"], {"images": {0: "batch"}, "embeddings": {0: "batch"}})


if __name__ == "__main__":
    main()
