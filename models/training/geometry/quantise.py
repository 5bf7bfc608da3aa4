"""Stores the weights of geometry.onnx that the CPU computes with in 8 bits as these 8 bits.

    python quantise.py geometry.onnx out.onnx

Each output channel has its own step. cpu_graph.py takes the same numbers, so its answers do not
change. Other devices compute with the rounded weights, as floats: a Cast and a Mul of constants, which
every runtime folds at load (ONNX Runtime leaves a DequantizeLinear to each run). What is seen at the
outputs stays in 16 bits (`KEPT` of cpu_graph.py).
"""
import sys

import numpy as np
import onnx
from onnx import TensorProto, helper

from cpu_graph import Graph, linear, quantised, steps_of


def rounded(weight, axis):
    """The weight in 8 bits, and the step of each channel along the axis."""
    step = steps_of(weight, axis)
    return np.clip(np.round(weight / step), -127, 127).astype(np.int8), step


def axes(g):
    """The weights that are computed in 8 bits, and the axis of their output channels."""
    return {n.input[1]: 0 for n, _ in quantised(g)} | {n.input[1]: 1 for n, _ in linear(g)}


def main(source, target):
    g = Graph(source)
    for name, axis in axes(g).items():
        q, step = rounded(g.value(name), axis)
        cast = g.makers[name]
        g.nodes.remove(cast)
        del g.inits[cast.input[0]]
        base = cast.input[0].removesuffix("_f16")
        bits, steps = g.constant(base + "_q", q), g.constant(base + "_s", step)
        g.nodes[:0] = [
            helper.make_node("Cast", [bits], [base + "_w"], base + "_w", to=TensorProto.FLOAT),
            helper.make_node("Mul", [base + "_w", steps], [name], base + "_m"),
        ]
    del g.graph.initializer[:], g.graph.node[:]
    g.graph.initializer.extend(g.inits.values())
    g.graph.node.extend(g.nodes)
    onnx.checker.check_model(g.model)
    onnx.save(g.model, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
