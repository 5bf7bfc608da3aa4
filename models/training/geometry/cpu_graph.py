"""geometry.onnx to geometry_cpu.onnx: the same network for CPUs, in about half the time.

    python cpu_graph.py geometry.onnx geometry_cpu.onnx ranges.json
    python cpu_graph.py geometry_many.onnx geometry_many_cpu.onnx ranges_many.json geometry.onnx

- Attention is one operator of ONNX Runtime (`MultiHeadAttention`).
- The plane sweep's product is one operator of the server (`segsplat:Correlate`,
  crates/vision/src/models/correlate.rs): the samples are never in memory.
- Places in a neighbour are computed as planes of x, y and w, not as triples.
- Convolutions and linear layers compute in 8 bits, but for those next to the outputs (`KEPT`).
  Ranges of activations come from `calibrate.py`; linear layers find theirs at each run.

The file holds no weights: it takes them from the files beside it, at their place there. So they are
always of one export; the manifest's hashes hold them together.
"""
import json
import os
import sys

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

HEADS = 6
# Sweeps whose samples are multiplied with a pixel's own features: the coarse one and the finer one.
PRODUCTS = 2
# Near the outputs 8 bits are seen: colours, the last depths, features that are compared.
KEPT = ("/head_in/", "/out/", "/up_h/", "/r_out/", "/m2/", "/m4/", "/logits/", "/u4/", "/stem/")

# Operators that weights are stored behind: quantise.py, difference.py.
STORED_BY = {
    "Cast": lambda x: x, "Mul": np.multiply, "Add": np.add, "Sub": np.subtract, "Floor": np.floor,
    "Concat": lambda *parts: np.concatenate(parts),
}


class Graph:
    """A model, its nodes by what they make, and its constants."""

    def __init__(self, path):
        self.model = onnx.load(path)
        self.graph = self.model.graph
        self.nodes = list(self.graph.node)
        self.inits = {i.name: i for i in self.graph.initializer}
        self.stored = set(self.inits)
        self.makers = {o: n for n in self.nodes for o in n.output}
        self.users = {}
        for n in self.nodes:
            for i in n.input:
                self.users.setdefault(i, []).append(n)

    def constant(self, name, value):
        self.inits[name] = numpy_helper.from_array(np.asarray(value), name)
        return name

    def value(self, name):
        """A constant as f32, through what it is stored behind; None where it is no constant."""
        if name in self.inits:
            return numpy_helper.to_array(self.inits[name]).astype(np.float32)
        maker = self.makers.get(name)
        if maker is None or maker.op_type not in STORED_BY:
            return None
        parts = [self.value(part) for part in maker.input]
        return None if any(part is None for part in parts) else STORED_BY[maker.op_type](*parts)

    def user(self, name, op):
        """The first node of type `op` that takes the value; shapes of it are taken, too."""
        return next((n for n in self.users.get(name, []) if n.op_type == op), None)

    def rename(self, names):
        for n in self.nodes:
            for k, i in enumerate(n.input):
                n.input[k] = names.get(i, i)

    def finish(self, path, external=()):
        """Sorts, drops what nothing needs, and writes; large constants stay in the files `external`."""
        have = {i.name for i in self.graph.input} | set(self.inits) | {""}
        order, todo = [], self.nodes
        while todo:
            ready = [n for n in todo if all(i in have for i in n.input)]
            if not ready:  # within one pass a node may wait for an earlier one of the same pass
                raise SystemExit(f"a cycle at {todo[0].name}")
            order += ready
            have |= {o for n in ready for o in n.output}
            todo = [n for n in todo if n.output[0] not in have]
        need, kept = {o.name for o in self.graph.output}, []
        for n in reversed(order):
            if any(o in need for o in n.output):
                kept.append(n)
                need |= set(n.input)
        inits = [i for i in self.inits.values() if i.name in need]
        for file in external:
            inits = [outside(i, file) if i.name in self.stored else i for i in inits]
        del self.graph.node[:], self.graph.initializer[:], self.graph.value_info[:]
        self.graph.node.extend(reversed(kept))
        self.graph.initializer.extend(inits)
        for domain in ("com.microsoft", "segsplat"):
            if not any(o.domain == domain for o in self.model.opset_import):
                self.model.opset_import.append(helper.make_opsetid(domain, 1))
        onnx.save(self.model, path)


def outside(init, path, least=1024):
    """The constant at its place in another file, if it is large and lies there."""
    if len(init.raw_data) < least:
        return init
    with open(path, "rb") as file:
        at = file.read().find(init.raw_data)
    if at < 0:
        return init
    there = onnx.TensorProto(name=init.name, data_type=init.data_type, dims=init.dims, data_location=TensorProto.EXTERNAL)
    for key, value in (("location", os.path.basename(path)), ("offset", at), ("length", len(init.raw_data))):
        there.external_data.add(key=key, value=str(value))
    return there


def attention(g):
    """Both attentions of each block as one operator each."""

    def behind(name, op):
        node = g.makers[name]
        while node.op_type != op:
            node = g.makers[node.input[0]]
        return node.input[0]

    for soft in [n for n in g.nodes if n.op_type == "Softmax" and ("/blocks." in n.name or "/g8x." in n.name)]:
        scores, product = g.makers[soft.input[0]], g.users[soft.output[0]][0]
        back = g.users[product.output[0]][0]
        joined = next(n for n in g.users[back.output[0]] if n.op_type == "Reshape")
        parts = [behind(x, "Reshape") for x in (*scores.input, product.input[1])]
        g.nodes.remove(joined)
        g.nodes.append(helper.make_node("MultiHeadAttention", parts, list(joined.output), soft.name + "_fused", domain="com.microsoft", num_heads=HEADS))


def sweeps(g):
    """Places as planes; products with samples as one operator."""
    names, products = {}, 0
    one, two, four, least = (g.constant(f"sweep_{k}", np.float32(v)) for k, v in (("one", 1), ("two", 2), ("four", 4), ("minus_four", -4)))
    last, thirds = g.constant("sweep_last", np.array([3])), g.constant("sweep_thirds", np.array([1, 1, 1]))
    for sampled in [n for n in g.nodes if n.op_type == "GridSample"]:
        tag = f"{sampled.name}/sweep_"
        clip = g.makers[sampled.input[1]]
        where = g.makers[clip.input[0]]
        div = g.makers[g.makers[g.makers[where.input[1]].input[0]].input[0]]
        add = g.makers[g.makers[div.input[0]].input[0]]
        base, shift = g.makers[add.input[0]].input[0], g.makers[add.input[1]]
        inverse, front = g.makers[shift.input[1]].input[0], g.makers[where.input[0]].input[0]
        depth, divisor = g.makers[front].input[0], g.makers[div.input[1]].input[0]
        distance = g.users[next(n for n in g.users[clip.output[0]] if n.op_type == "Abs").output[0]][0]
        if [n.op_type for n in (clip, where, div, add, distance)] != ["Clip", "Where", "Div", "Add", "ReduceMax"]:
            raise SystemExit(f"{sampled.name} is not the sweep that this script knows")

        def node(op, inputs, *outputs, **attributes):
            outputs = [tag + o for o in outputs]
            g.nodes.append(helper.make_node(op, inputs, outputs, outputs[0], **attributes))
            return outputs if len(outputs) > 1 else outputs[0]

        bases = node("Split", [node("Transpose", [base], "base", perm=[0, 2, 1]), thirds], "bx", "by", "bw", axis=1)
        shifts = node("Split", [shift.input[0], thirds], "tx", "ty", "tw", axis=3)
        x, y, w = (
            node("Add", [node("Mul", [node("Squeeze", [t, last], c + "t"), inverse], c + "m"), b], c) for c, t, b in zip("xyw", shifts, bases)
        )
        scale = node("Div", [two, divisor], "scale")
        places = []
        for c, p in (("x", x), ("y", y)):
            p = node("Sub", [node("Mul", [p, scale], c + "1"), one], c + "2")
            places.append(node("Clip", [node("Where", [front, p, four], c + "3"), least, four], c + "4"))
        names[depth] = w
        names[distance.output[0]] = node("Max", [node("Abs", [p], c + "5") for c, p in zip("xy", places)], "distance")
        product = g.user(sampled.output[0], "Mul")
        if product:
            own = g.makers[sampled.input[0]].input[0]
            parts = g.user(product.output[0], "Reshape")
            total = parts and g.user(parts.output[0], "ReduceSum")
            if not total:
                raise SystemExit(f"{sampled.name} is not the product that this script knows")
            groups = 2 if sampled.name.endswith("GridSample") else 1
            products += 1
            names[total.output[0]] = node("Correlate", [sampled.input[0], own, *places], "product", domain="segsplat", groups=groups)
            # Others ask for the shape of the samples: that of the maps, and that of the places.
            maps, at = (node("Shape", [x], c, start=first, end=first + 2) for x, c, first in ((sampled.input[0], "maps", 0), (places[0], "at", 1)))
            shape = node("Concat", [maps, at], "shape", axis=0)
            names |= {n.output[0]: shape for n in g.users[sampled.output[0]] if n.op_type == "Shape"}
        else:
            names[clip.output[0]] = node("Concat", [node("Unsqueeze", [p, last], c + "6") for c, p in zip("xy", places)], "places", axis=3)
    if products != PRODUCTS:
        raise SystemExit(f"{products} of {PRODUCTS} products with samples were found")
    g.rename(names)


def quantised(g):
    """Convolutions that are computed in 8 bits: [(node, weight)]."""
    for n in g.nodes:
        grouped = any(a.name == "group" and a.i > 1 for a in n.attribute)
        if n.op_type == "Conv" and not grouped and not any(k in n.name for k in KEPT):
            yield n, g.value(n.input[1])


def linear(g):
    """Linear layers that are computed in 8 bits: [(node, weight)]."""
    for n in g.nodes:
        value = g.value(n.input[1]) if n.op_type == "MatMul" else None
        if value is not None and value.ndim == 2 and value.shape[0] >= 96:
            yield n, value


def steps_of(weight, axis):
    """The step of each channel along an axis in 8 bits, in a shape to multiply by."""
    others = tuple(k for k in range(weight.ndim) if k != axis)
    return np.maximum(np.abs(weight).max(others, keepdims=True), 1e-8).astype(np.float32) / np.float32(127)


def eight_bits(g, ranges):
    def steps(name):
        low, high = min(ranges[name][0], 0.0), max(ranges[name][1], 0.0)
        scale = np.float32(max(high - low, 1e-6) / 255)
        return scale, np.uint8(np.clip(round(-low / scale), 0, 255))

    def rounded(name, source, tag):
        """`source` in 8 bits and back; nodes that follow see the rounded numbers as f32."""
        scale, zero = steps(name)
        s, z = g.constant(f"{name}{tag}_s", scale), g.constant(f"{name}{tag}_z", zero)
        g.nodes.append(helper.make_node("QuantizeLinear", [source, s, z], [f"{name}{tag}_q"], f"{name}{tag}_q"))
        return helper.make_node("DequantizeLinear", [f"{name}{tag}_q", s, z], [f"{name}{tag}_d"], f"{name}{tag}_d"), scale

    def weight(name, axis):
        """The 8 bits of a weight, their steps, zero, and the steps' numbers."""
        back = g.makers[name]
        if back.op_type == "Mul":  # as quantise.py stored it
            bits, scale = g.makers[back.input[0]].input[0], g.value(back.input[1]).ravel()
        else:  # the sum of difference.py is rounded at load
            bits, scale = name + "_q8", steps_of(g.value(name), axis).ravel()
        steps = g.constant(name + "_s8", scale)
        zero = g.constant(name + "_z8", np.zeros(scale.size, np.int8))
        if back.op_type != "Mul":
            g.nodes.append(helper.make_node("QuantizeLinear", [name, steps, zero], [bits], bits, axis=axis))
        return bits, steps, zero, scale

    inputs = {}
    for n, _ in list(quantised(g)):
        x, y, w = n.input[0], n.output[0], n.input[1]
        if x not in inputs:
            back, scale = rounded(x, x, "_in")
            g.nodes.append(back)
            inputs[x] = back.output[0], scale
        source, step = inputs[x]
        q, s, z, scale = weight(w, 0)
        g.nodes.append(helper.make_node("DequantizeLinear", [q, s, z], [w + "_d8"], w + "_d8", axis=0))
        bias = g.value(n.input[2])
        b = g.constant(n.input[2] + "_b8", np.round(bias / (scale * step)).astype(np.int32))
        bs = g.constant(n.input[2] + "_bs8", (scale * step).astype(np.float32))
        g.nodes.append(helper.make_node("DequantizeLinear", [b, bs], [b + "_d"], b + "_d", axis=0))
        n.input[0], n.input[1], n.input[2], n.output[0] = source, w + "_d8", b + "_d", y + "_f"
        back, _ = rounded(y, y + "_f", "_out")
        back.output[0] = y
        g.nodes.append(back)
    for n, _ in list(linear(g)):
        q, s, _, _ = weight(n.input[1], 1)
        g.nodes.remove(n)
        g.nodes.append(helper.make_node("DynamicQuantizeMatMul", [n.input[0], q, s], list(n.output), n.name, domain="com.microsoft"))


def main(source, target, ranges, *others):
    g = Graph(source)
    attention(g)
    sweeps(g)
    with open(ranges) as file:
        eight_bits(g, json.load(file))
    g.finish(target, (source, *others))


if __name__ == "__main__":
    main(*sys.argv[1:])
