"""The ranges of activations in 8 bits with the least square error, on sets of photos of the captures that train.

    python ranges_of_sets.py --data DATA --weights many.pt --graph geometry_many.onnx --out ranges_many.json

calibrate.py takes the smallest and largest number; here what is rarely reached is cut, so that the
others have finer steps. Two passes over the same sets: the first finds the ends, the second counts. On a GPU, half a minute.
"""
import argparse
import json

import numpy as np
import torch

from cpu_graph import Graph, quantised
from model import GeometryNet
from photos import Captures
from splats import nearest_views
from weights import module_of

BINS = 2048
TRIED = np.linspace(0.12, 1, 23)  # shares of each end
WIDER = 1.05
VIEWS = (8, 4, 6)
SHAPES = ((256, 256), (224, 288), (288, 224))


class Counts:
    """How often numbers of a tensor fall into each of BINS steps between its ends."""

    def __init__(self):
        self.low = self.high = self.bins = None

    def see(self, x):
        x = x.detach().float().flatten()
        if self.bins is None:
            low, high = x.min().clamp(max=0), x.max().clamp(min=0)
            self.low = low if self.low is None else torch.minimum(self.low, low)
            self.high = high if self.high is None else torch.maximum(self.high, high)
        else:
            at = ((x - self.low) * (BINS / (self.high - self.low))).clamp(0, BINS - 1).long()
            self.bins += torch.bincount(at, minlength=BINS)

    def range(self):
        low, high, bins = self.low.item(), self.high.item(), self.bins.double().cpu().numpy()
        x = low + (np.arange(BINS) + 0.5) * (high - low) / BINS

        def error(l, h):
            outside = np.maximum(l - x, 0) ** 2 + np.maximum(x - h, 0) ** 2
            return (bins * np.where(outside > 0, outside, ((h - l) / 255) ** 2 / 12)).sum()

        best = min((error(low * a, high * b), low * a, high * b) for a in TRIED for b in TRIED)
        return [round(WIDER * v, 4) for v in best[1:]]


@torch.no_grad()
def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--data", required=True)
    ap.add_argument("--weights", required=True)
    ap.add_argument("--graph", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--batches", type=int, default=60)
    ap.add_argument("--photos", type=int, default=16, help="of a batch")
    args = ap.parse_args()
    torch.backends.cuda.matmul.allow_tf32 = False
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    net = GeometryNet().to(device).eval()
    net.load_state_dict({k: v.float() for k, v in torch.load(args.weights, map_location="cpu").items()})
    nodes = {module_of(n): n for n, _ in quantised(Graph(args.graph))}
    counts = {name: Counts() for n in nodes.values() for name in (n.input[0], n.output[0])}
    for name, module in net.named_modules():
        if name in nodes:
            module.register_forward_hook(lambda m, x, y, n=nodes[name]: counts[n.input[0]].see(x[0]) or counts[n.output[0]].see(y))
    for counting in (False, True):
        captures = Captures(args.data, device, 7)
        for c in counts.values() if counting else ():
            c.bins = torch.zeros(BINS, dtype=torch.long, device=device)
        for k in range(args.batches):
            views, (h, w) = VIEWS[k % len(VIEWS)], SHAPES[k // len(VIEWS) % len(SHAPES)]
            images, _, _, K, c2w, near, far = captures.batch(max(args.photos // views, 1), views, 1, (h, w), (h, w))
            net(images, K[:, :views], c2w[:, :views], near, far, nearest_views(c2w[:, :views], 3))
    with open(args.out, "w") as file:
        json.dump({name: c.range() for name, c in counts.items()}, file, indent=0)
        file.write("\n")


if __name__ == "__main__":
    main()
