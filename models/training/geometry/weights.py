"""The weights of a shipped file back as a state of `GeometryNet`, to go on training from what ships.

    python weights.py ../../embedded/geometry.onnx start.pt
    python weights.py ../../embedded/geometry_many.onnx start_many.pt
"""
import sys

import numpy as np
import torch

from cpu_graph import STORED_BY, Graph
from model import GeometryNet


def module_of(node):
    """`/net/e2/e2.0/n1/Mul` is of the module `e2.0.n1`."""
    parts = []
    for part in node.name.split("/")[2:-1]:
        if parts and part.startswith(parts[-1] + "."):
            parts.pop()
        parts.append(part)
    return ".".join(parts)


def state(path):
    g = Graph(path)
    names = [*g.inits, *(o for n in g.nodes if n.op_type in STORED_BY for o in n.output)]
    found = {name: value for name in names if (value := g.value(name)) is not None}
    want = GeometryNet().state_dict()
    out = {k: found["net." + k] for k in want if "net." + k in found}
    for n in g.nodes:
        kind = {"MatMul": "weight", "Mul": "weight", "Add": "bias"}.get(n.op_type)
        for name in n.input:
            key = f"{module_of(n)}.{kind}"
            if kind and name in found and key in want and key not in out:
                value = found[name].T if n.op_type == "MatMul" else found[name]
                if value.size == want[key].numel():
                    out[key] = value.reshape(want[key].shape) if n.op_type != "MatMul" else value
    # Convolutions that export.py filled up to a multiple of 4 channels.
    for k, v in want.items():
        if k not in out:
            raise SystemExit(f"{path} has no {k}")
        if out[k].shape != v.shape:
            out[k] = out[k][:, : v.shape[1]]
        if out[k].shape != v.shape:
            raise SystemExit(f"{k}: {out[k].shape}, not {tuple(v.shape)}")
    return {k: torch.from_numpy(np.array(out[k], np.float32)) for k in want}


if __name__ == "__main__":
    torch.save({k: v.half() for k, v in state(sys.argv[1]).items()}, sys.argv[2])
