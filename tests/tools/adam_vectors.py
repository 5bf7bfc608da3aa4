"""Writes crates/render/tests/it/adam.csv: PyTorch's Adam on a few Gaussians and an exposure.

    python tests/tools/adam_vectors.py

Needs torch (CPU). crates/render/tests/it/adam.rs takes the same steps and compares. In f64, with
autograd through the logarithms of scales and the logits of opacities; each Gaussian has an
optimizer of its own, which steps when it is seen.
"""

import csv
from pathlib import Path

import torch

STEPS, GAUSSIANS, SH = 24, 3, 4
RATES = {
    "means": 1e-2, "quats": 2e-3, "scales": 5e-3,
    "opacities": 5e-2, "sh": 2.5e-3, "sh_rest": 1.25e-4,
}
# Sizes of the gradients of each number: squares of some are no f32, those of others are large.
SIZES = [1.0, 1e-3, 1e6] + [1e-2] * 4 + [10.0, 1e-8, 1e-14] + [1e-4]
SIZES += [1.0, 1e-10, 1e15, 1e-12, 1e-14, 1e-15, 1e-16, 1e-18, 1e-20, 1e-25, 1e-30, 1e10]
OUT = Path(__file__).parents[2] / "crates/render/tests/it/adam.csv"


class Random:
    """SplitMix64, as in tests/support/src/scenes.rs."""

    def __init__(self, seed: int) -> None:
        self.state = seed

    def unit(self) -> float:
        mask = (1 << 64) - 1
        self.state = (self.state + 0x9E3779B97F4A7C15) & mask
        z = self.state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return ((z ^ (z >> 31)) >> 40) / (1 << 24)


def seen(i: int, step: int) -> bool:
    return [True, step % 3 != 1, step >= 10][i]


def gaussians() -> list[list[float]]:
    """The numbers of each Gaussian after all steps, in the order of the gradients."""
    f64 = torch.float64
    states = []
    for i in range(GAUSSIANS):
        means = torch.tensor([0.5, -0.25, float(i)], dtype=f64, requires_grad=True)
        quats = torch.tensor([0.5, 0.5, -0.5, 0.5], dtype=f64, requires_grad=True)
        scales = torch.tensor([0.5, 0.25, 0.125], dtype=f64).log().requires_grad_()
        opacity = torch.logit(torch.tensor([0.25], dtype=f64)).requires_grad_()
        sh = torch.zeros(3, dtype=f64, requires_grad=True)
        sh_rest = torch.zeros(3 * (SH - 1), dtype=f64, requires_grad=True)
        numbers = [means, quats, scales, opacity, sh, sh_rest]
        pairs = zip(numbers, RATES.values(), strict=True)
        groups = [{"params": [p], "lr": rate} for p, rate in pairs]
        states.append((numbers, torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)))
    random = Random(7)
    for step in range(STEPS):
        for i, (numbers, optimizer) in enumerate(states):
            by = torch.tensor([(random.unit() - 0.25) * size for size in SIZES], dtype=f64)
            if not seen(i, step):
                continue
            means, quats, scales, opacity, sh, sh_rest = numbers
            linear = torch.cat([means, quats, scales.exp(), opacity.sigmoid(), sh, sh_rest])
            optimizer.zero_grad()
            (linear * by).sum().backward()
            optimizer.step()
            with torch.no_grad():
                quats /= quats.norm()
    return [
        torch.cat([means, quats, scales.exp(), opacity.sigmoid(), sh, sh_rest]).tolist()
        for (means, quats, scales, opacity, sh, sh_rest), _ in states
    ]


def exposure() -> list[float]:
    """Gains, then biases, of a photo that is darker than what is drawn."""
    random, f64 = Random(8), torch.float64
    color = [[0.5 + 0.5 * random.unit() for _ in range(3)] for _ in range(8)]
    color = torch.tensor(color, dtype=f64)
    photo = torch.tensor([[8 * at + c for c in range(3)] for at in range(8)], dtype=f64) / 255
    gain = torch.ones(3, dtype=f64, requires_grad=True)
    bias = torch.zeros(3, dtype=f64, requires_grad=True)
    optimizer = torch.optim.Adam([gain, bias], lr=5e-3, betas=(0.9, 0.999), eps=1e-15)
    for _ in range(STEPS):
        optimizer.zero_grad()
        away = (gain * color + bias - photo).abs().mean()
        (away + ((gain - 1) ** 2).sum() + (bias**2).sum()).backward()
        optimizer.step()
    return [*gain.tolist(), *bias.tolist()]


with OUT.open("w", newline="") as file:
    rows = csv.writer(file, lineterminator="\n")
    file.write("# PyTorch's Adam: each Gaussian's numbers, then an exposure's")
    file.write(" (tests/tools/adam_vectors.py)\n")
    for row in [*gaussians(), exposure()]:
        rows.writerow([f"{value:.9e}" for value in row])
