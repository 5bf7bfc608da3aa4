"""LPIPS (PyPI `lpips` 0.1.4) as one ONNX file, for `benches/published/re10k.py --lpips FILE`.

    python perceptual.py --checkpoint vgg16-397923af.pth --out lpips.onnx
    python perceptual.py --random 1 --out lpips.onnx

The checkpoint is torchvision's VGG 16, with `--net alex` its AlexNet. The weights of the layers over it come with the
package. Inputs: `a` and `b`, `[1, 3, H, W]` f32 in -1 to 1, of any size from 32 x 32. Output: `distance`, `[1]`.
"""
import argparse
import sys

import lpips
import torch

from common import export, gap, hold, prepare, session

# Sizes of the comparison with PyTorch: that of the export, that of RealEstate10K, and one that is no multiple of 2.
SIZES = [(64, 64), (256, 256), (75, 110)]


class Distance(torch.nn.Module):
    def __init__(self, own):
        super().__init__()
        self.own = own

    def forward(self, a, b):
        return self.own(a, b).reshape(1)


def network(net, checkpoint):
    """LPIPS with the trunk of this file, or with a random one. The package itself would download the trunk."""
    own = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)
    if checkpoint:
        weights = torch.load(checkpoint, map_location="cpu", weights_only=True)
        for place in own.net.children():
            for name, layer in place.named_children():
                if list(layer.parameters()):
                    of = {part: weights[f"features.{name}.{part}"] for part in ("weight", "bias")}
                    layer.load_state_dict(of)
    return own.eval()


def check(own, path):
    run, generator = session(path), torch.Generator().manual_seed(7)
    for height, width in SIZES:
        a = torch.rand(1, 3, height, width, generator=generator) * 2 - 1
        for name, b in {"another picture": -a.flip(3), "a little noise": (a + 0.05 * torch.randn(a.shape, generator=generator)).clamp(-1, 1)}.items():
            found = run.run(["distance"], {"a": a.numpy(), "b": b.numpy()})[0]
            hold(f"{height} x {width}, {name}: {float(found[0]):.4f}", gap(found, own(a, b).reshape(1)), 1e-4)
        same = run.run(["distance"], {"a": a.numpy(), "b": a.numpy()})[0]
        hold(f"{height} x {width}, the same picture", abs(float(same[0])), 1e-7)


def main():
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--out", required=True, help="the ONNX file")
    ap.add_argument("--net", choices=["vgg", "alex"], default="vgg")
    weights = ap.add_mutually_exclusive_group(required=True)
    weights.add_argument("--checkpoint", help="torchvision's file of the trunk")
    weights.add_argument("--random", type=int, metavar="SEED", help="the same network with a random trunk")
    args = ap.parse_args()
    prepare(args)
    own = network(args.net, args.checkpoint)
    pictures = {name: torch.rand(1, 3, *SIZES[0]) * 2 - 1 for name in ("a", "b")}
    dynamic = {name: {2: "height", 3: "width"} for name in pictures}
    export(Distance(own).eval(), pictures, args.out, ["distance"], dynamic)
    check(own, args.out)


if __name__ == "__main__":
    sys.exit(main())
