"""The network with the roundings of its CPU file, for training and for judging in PyTorch.

What cpu_graph.py computes in 8 bits is rounded here at the same places: a convolution's input and answer by
the ranges of calibrate.py, a linear layer's input by the smallest and largest number of its set, weights by
the step of each output channel. With a first file, weights are its own plus a difference in 4 bits, as
difference.py stores them. Gradients pass the roundings as if these were not there (straight through), but
for numbers outside of a range.
"""
import json

import torch
import torch.nn as nn

from cpu_graph import KEPT, Graph, quantised
from difference import MOST, TRIED
from weights import module_of, state

FRESH = 100  # uses of a weight until the steps of its 4 bits are chosen again
LEAST_INPUTS = 96  # of a linear layer in 8 bits, as in cpu_graph.py


def ranges_of(graph, path):
    """{module: (range of its input, range of its answer)} for the convolutions in 8 bits."""
    with open(path) as file:
        ranges = json.load(file)
    return {module_of(n): (ranges[n.input[0]], ranges[n.output[0]]) for n, _ in quantised(Graph(graph))}


def steps_by_channel(weight):
    return weight.detach().flatten(1).abs().amax(1).clamp(min=1e-8)


def four_bit_steps(change):
    """Of the least square error, for each output channel: in_four_bits of difference.py."""
    flat = change.detach().flatten(1)
    largest = flat.abs().amax(1, keepdim=True).clamp(min=1e-8)
    best = least = None
    for share in TRIED:
        step = largest * (float(share) / MOST)
        error = (((flat / step).round().clamp(-MOST, MOST) * step - flat) ** 2).sum(1, keepdim=True)
        better = error < least if best is not None else torch.ones_like(error, dtype=torch.bool)
        best = step if best is None else torch.where(better, step, best)
        least = error if least is None else torch.where(better, error, least)
    return best[:, 0]


def by_channel(x, step, most):
    return torch.fake_quantize_per_channel_affine(x, step, torch.zeros_like(step, dtype=torch.int32), 0, -most, most)


class Rounding:
    """A range of 8 bits, wide enough for 0."""

    def __init__(self, low, high):
        low, high = min(low, 0.0), max(high, 0.0)
        self.scale = max(high - low, 1e-6) / 255
        self.zero = min(max(round(-low / self.scale), 0), 255)

    def __call__(self, x):
        return torch.fake_quantize_per_tensor_affine(x, self.scale, self.zero, 0, 255)


class EightBits:
    """Rounds in a network while `on`; `skip` names modules that stay in float."""

    def __init__(self, net, graph, ranges, first=None):
        self.on, self.skip, self.sets = True, set(), 1
        self.weights_on, self.inputs_on, self.answers_on, self.linear_on = True, True, True, True
        found, base = ranges_of(graph, ranges), state(first) if first else {}
        net.register_forward_pre_hook(self.count_sets)
        self.layers = []
        for name, m in net.named_modules():
            conv = isinstance(m, nn.Conv2d) and m.groups == 1 and f"/{name.split('.')[0]}/" not in KEPT
            if not conv and not (isinstance(m, nn.Linear) and m.in_features >= LEAST_INPUTS):
                continue
            m.register_buffer("first", base[f"{name}.weight"].float().to(m.weight.device) if base else None, persistent=False)
            m.four, m.age = None, 0
            if conv:
                m.given, m.answer = (Rounding(*r) for r in found[name])
            m.forward = (self.conv if conv else self.linear)(name, m)
            self.layers.append(name)
        missing = set(found) - set(self.layers)
        if missing:
            raise SystemExit(f"{graph}: no such layers: {sorted(missing)}")

    def count_sets(self, net, args):
        self.sets = args[0].shape[0]

    def weight(self, m):
        if not self.weights_on:
            return m.weight
        w = m.weight
        if m.first is not None:
            if m.four is None or m.age >= FRESH:
                m.four, m.age = four_bit_steps(w - m.first), 0
            m.age += 1
            w = m.first + by_channel(w - m.first, m.four, MOST)
        return by_channel(w, steps_by_channel(w) / 127, 127)

    def conv(self, name, m):
        def forward(x):
            if not self.on or name in self.skip:
                return m._conv_forward(x, m.weight, m.bias)
            y = m._conv_forward(m.given(x) if self.inputs_on else x, self.weight(m), m.bias)
            return m.answer(y) if self.answers_on else y

        return forward

    def linear(self, name, m):
        def forward(x):
            if not self.on or name in self.skip:
                return nn.functional.linear(x, m.weight, m.bias)
            if not self.linear_on:
                return nn.functional.linear(x, self.weight(m), m.bias)
            rows = x.reshape(self.sets, -1)
            low, high = (f(1).clamp(**c).float() for f, c in ((rows.detach().amin, {"max": 0}), (rows.detach().amax, {"min": 0})))
            scale = ((high - low) / 255).clamp(min=1e-8)
            zero = (-low / scale).round().clamp(0, 255).to(torch.int32)
            x = torch.fake_quantize_per_channel_affine(rows, scale, zero, 0, 0, 255).reshape(x.shape)
            return nn.functional.linear(x, self.weight(m), m.bias)

        return forward
