"""Writes a tower of `train_pooled.py` as the bundle's image tower: crops and whole photos, one file.

    python pooled_export.py --pack PACK --weights last.pt --share 0.5 --out image_tower.onnx [--wide 0.9]

`images` [B,3,H,W], sides in whole multiples of 32. `embeddings` [B,384] of unit length: a cut of 224 x 224 on black, as before.
`dense` [B,384,H/32,W/32]: the mean of it under a mask (weights: the share of each cell that lies under it), made unit, is the
embedding of that thing in the whole photo. --share goes from the bundle's tower to the trained one; --wide keeps
the layers that suffer most from 8 bits in f16, so many MiB more at most.
"""
import argparse

import onnx
import torch
import torch.nn.functional as F
from onnx import helper, numpy_helper

import export
from pooled_judge import tower_of


class Exported(torch.nn.Module):
    def __init__(self, tower):
        super().__init__()
        self.tower = tower

    def forward(self, images):
        m = self.tower.maps(images)
        embeddings = F.normalize(self.tower.out(m.mean((2, 3))), dim=-1)
        return embeddings, self.tower.dense(m)


def widened(path, exact, budget):
    """Puts the costliest layers for their size back as f16: by squared error of 8 bits a number, until `budget` bytes are spent."""
    model = onnx.load(path)
    graph, inits = model.graph, {i.name: i for i in model.graph.initializer}
    rows = []
    for n in graph.node:
        if n.op_type == "DequantizeLinear" and n.output[0].startswith("tower.body."):
            w = exact[n.output[0][len("tower."):]].float()
            q, s = (torch.from_numpy(numpy_helper.to_array(inits[i]).copy()).float() for i in n.input)
            error = (q * s.view(-1, *[1] * (q.ndim - 1)) - w).square().sum() / w.square().sum()
            rows.append((float(error) / w.numel(), n, w))
    rows.sort(key=lambda r: -r[0])
    spent = 0
    for _, n, w in rows:
        if spent + w.numel() > budget:
            continue
        spent += w.numel()
        for i in n.input:
            graph.initializer.remove(inits[i])
        at = list(graph.node).index(n)
        name = n.output[0]
        graph.node.remove(n)
        graph.initializer.append(numpy_helper.from_array(w.half().numpy(), name + "_h"))
        graph.node.insert(at, helper.make_node("Cast", [name + "_h"], [name], to=onnx.TensorProto.FLOAT))
    onnx.save(model, path)
    print("kept in f16:", spent, "weights more bytes")


@torch.no_grad()
def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--pack", required=True, help="start.npz is read from it")
    ap.add_argument("--weights", required=True)
    ap.add_argument("--share", type=float, default=0.5)
    ap.add_argument("--wide", type=float, default=0.0, help="MiB")
    ap.add_argument("--out", required=True)
    args = ap.parse_args()
    tower = tower_of(args.pack, torch.device("cpu"), args.weights, args.share).to(memory_format=torch.contiguous_format)
    whole = {0: "batch", 2: "height", 3: "width"}
    export.write(Exported(tower), (torch.rand(2, 3, 224, 288) * 2 - 1,), args.out, ["images"], ["embeddings", "dense"],
                 {"images": whole, "embeddings": {0: "batch"}, "dense": {0: "batch", 2: "rows", 3: "columns"}})
    if args.wide:
        widened(args.out, tower.state_dict(), args.wide * 2**20)


if __name__ == "__main__":
    main()
