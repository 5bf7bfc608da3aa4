"""A second network of the same form as its difference from the first, in 4 bits.

    python difference.py geometry.onnx many_full.onnx geometry_many.onnx

geometry.onnx is of quantise.py, many_full.onnx of export.py. What the first file stores in 8 bits is
taken from it, at its place there; the second adds its difference, two numbers a byte: rows of the first
half of axis 0 in the low bits, those of the second half in the high ones. Each output channel has the
step of the least square error. All of it is arithmetic of constants, which runtimes fold at load.
"""
import sys

import numpy as np
import onnx
from onnx import TensorProto, helper

from cpu_graph import Graph, outside
from quantise import axes

MOST = 7  # steps, to either side
TRIED = np.linspace(0.35, 1.0, 27)


def in_four_bits(change, axis):
    """(numbers -7 to 7, step of each channel along the axis)."""
    others = tuple(k for k in range(change.ndim) if k != axis)
    largest = np.maximum(np.abs(change).max(others, keepdims=True), 1e-8)
    round_to = lambda step: np.clip(np.round(change / step), -MOST, MOST)
    steps = [(largest * share / MOST).astype(np.float32) for share in TRIED]
    errors = np.stack([((round_to(step) * step - change) ** 2).sum(others, keepdims=True) for step in steps])
    step = np.take_along_axis(np.stack(steps), errors.argmin(0)[None], 0)[0]
    return round_to(step), step


def packed(numbers):
    low, high = np.split(numbers + MOST + 1, 2)
    return (low + 16 * high).astype(np.uint8)


def main(first, source, target):
    base, g = Graph(first), Graph(source)
    worst = 0.0
    shared = []
    for part, value in (("sixteenth", 1 / 16), ("sixteen", 16), ("middle", MOST + 1)):
        g.constant(f"difference_{part}", np.float32(value))
    for name, axis in axes(g).items():
        cast, stored = g.makers[name], base.makers[name]
        bits, steps = base.makers[stored.input[0]].input[0], stored.input[1]
        whole = g.value(name)
        numbers, step = in_four_bits(whole - base.value(name), axis)
        worst = max(worst, float(np.linalg.norm(base.value(name) + numbers * step - whole) / np.linalg.norm(whole)))
        g.nodes.remove(cast)
        del g.inits[cast.input[0]]
        for shared_name in (bits, steps):
            g.inits[shared_name] = base.inits[shared_name]
        shared += [bits, steps]
        d = cast.input[0].removesuffix("_f16") + "_d"
        two, step = g.constant(d, packed(numbers)), g.constant(d + "s", step)
        node = lambda op, inputs, out, **kw: helper.make_node(op, inputs, [out], out if out != name else d + "sum", **kw)
        g.nodes[:0] = [
            node("Cast", [two], d + "f", to=TensorProto.FLOAT),
            node("Mul", [d + "f", "difference_sixteenth"], d + "p"),
            node("Floor", [d + "p"], d + "h"),
            node("Mul", [d + "h", "difference_sixteen"], d + "q"),
            node("Sub", [d + "f", d + "q"], d + "l"),
            node("Concat", [d + "l", d + "h"], d + "b", axis=0),
            node("Sub", [d + "b", "difference_middle"], d + "c"),
            node("Mul", [d + "c", step], d + "m"),
            node("Cast", [bits], d + "g", to=TensorProto.FLOAT),
            node("Mul", [d + "g", steps], d + "w"),
            node("Add", [d + "w", d + "m"], name),
        ]
    print(f"largest error of a layer: {worst:.4f} of its norm")
    del g.graph.initializer[:], g.graph.node[:]
    g.graph.initializer.extend(outside(i, first) if k in shared else i for k, i in g.inits.items())
    g.graph.node.extend(g.nodes)
    onnx.save(g.model, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
