"""The mean of the weights of two runs.

    python mean.py a.pt b.pt mean.pt
"""
import sys

import torch


def main(first, second, target):
    a, b = (torch.load(path, map_location="cpu") for path in (first, second))
    torch.save({name: ((a[name].float() + b[name].float()) / 2).half() for name in a}, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
