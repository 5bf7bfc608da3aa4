"""The weights of geometry.onnx back as a state of `GeometryNet`, to go on training from what ships.

    python weights.py ../../embedded/geometry.onnx start.pt
"""
import sys

import numpy as np
import onnx
import torch
from onnx import numpy_helper

from model import GeometryNet


def module_of(node):
    """`/net/e2/e2.0/n1/Mul` is of the module `e2.0.n1`."""
    parts = []
    for part in node.name.split("/")[2:-1]:
        if parts and part.startswith(parts[-1] + "."):
            parts.pop()
        parts.append(part)
    return ".".join(parts)


def values(graph):
    """All stored numbers by the name that nodes use, with their Cast or 8 bits undone."""
    found = {t.name: numpy_helper.to_array(t) for t in graph.initializer}
    for n in graph.node:
        if n.op_type == "Cast" and n.input[0] in found:
            found[n.output[0]] = found[n.input[0]].astype(np.float32)
        elif n.op_type == "DequantizeLinear" and n.input[0] in found:
            scale = found[n.input[1]]
            found[n.output[0]] = found[n.input[0]].astype(np.float32) * scale.reshape(-1, 1, 1, 1)
    return found


def state(path):
    graph = onnx.load(path).graph
    found = values(graph)
    want = GeometryNet().state_dict()
    out = {k: found["net." + k] for k in want if "net." + k in found}
    for n in graph.node:
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
