"""Index pictures of photographs that have no outlines, by the bundle's own mask network in PyTorch.

    python pooled_masks.py --bundle ../../embedded --out PACK      # packs masks.npz, and checks it against ONNX Runtime

`Everything(pack).label(photo)` -> u8 [h/4,w/4] of the photo at 512 pixels: a number a mask, smaller ones on top.
"""
import argparse
import os

import numpy as np
import torch
from PIL import Image

from masks_model import MaskNet
from towers import plain

SIDE, POINTS = 512, 20
LEAST, MOST, SURE, STABLE, ALIKE = 0.004, 0.9, 0.35, 0.5, 0.6  # areas; predicted IoU, stability; IoU of two masks that are one


def flat(net):
    """The network as it is exported: batch norm inside the convolutions."""
    plain(net.encoder.body)
    for m in net.encoder.modules():
        if isinstance(m, torch.nn.Sequential):
            for i in range(len(m) - 1):
                if isinstance(m[i], torch.nn.Conv2d) and isinstance(m[i + 1], torch.nn.BatchNorm2d):
                    m[i].bias, m[i + 1] = torch.nn.Parameter(torch.zeros(m[i].out_channels)), torch.nn.Identity()
    return net


def weights(path):
    """Weights of an exported file by the names of the network: a product's matrix is named by the node that uses it."""
    import onnx

    from towers import folded

    state, graph = folded(path), onnx.load(path).graph
    raw = {i.name: torch.from_numpy(onnx.numpy_helper.to_array(i).copy()) for i in graph.initializer}
    for n in graph.node:
        if n.op_type == "MatMul" and n.input[1].startswith("onnx::"):
            parts = []
            for p in n.name.strip("/").split("/")[:-1]:
                parts = parts[:-1] + [p] if parts and p.startswith(parts[-1] + ".") else parts + [p]
            state[".".join(parts) + ".weight"] = state.pop(n.input[1]).T if n.input[1] in state else raw[n.input[1]].T
    waves = [k for k in state if k.startswith("onnx::Mul_")]
    if waves:
        state["waves"] = torch.stack([state[k] for k in waves[:2]])
    return {k: v for k, v in state.items() if not k.startswith("onnx::")}


class Everything:
    def __init__(self, pack, device):
        self.device, self.net = device, flat(MaskNet(SIDE))
        with np.load(os.path.join(pack, "masks.npz")) as z:
            self.net.load_state_dict({k: torch.from_numpy(z[k].astype(np.float32)) for k in z.files})
        self.net.to(device).eval()

    def picture(self, photo):
        k = SIDE / max(photo.shape[:2])
        w, h = round(photo.shape[1] * k), round(photo.shape[0] * k)
        x = np.zeros((3, SIDE, SIDE), np.float32)
        x[:, :h, :w] = ((np.asarray(Image.fromarray(photo).resize((w, h), Image.BILINEAR), np.float32) - 127) / 128).transpose(2, 0, 1)
        return torch.from_numpy(x)[None].to(self.device), h, w

    @torch.no_grad()
    def label(self, photo, points=POINTS):
        x, h, w = self.picture(photo)
        g = (torch.arange(points, device=self.device) + 0.5) / points
        xy = torch.stack([g.repeat(points) * w, g.repeat_interleave(points) * h], -1)[:, None] - 0.5
        logits, predicted = self.net.decoder(self.net.encoder(x), xy, torch.ones(len(xy), 1, device=self.device))
        gh, gw = -(-h // 4), -(-w // 4)
        logits = logits[:, :, :gh, :gw].flatten(2)
        stable = (logits > 1).sum(2) / (logits > -1).sum(2).clamp(min=1)
        area = (logits > 0).float().mean(2)
        ok = (predicted > SURE) & (stable > STABLE) & (area > LEAST) & (area < MOST)
        masks, sure = (logits > 0)[ok], (predicted * stable)[ok]
        order = sure.argsort(descending=True)[:200]
        m = masks[order].float()
        both = m @ m.T
        iou = (both / (m.sum(1)[:, None] + m.sum(1) - both).clamp(min=1)).cpu().numpy()
        kept = []
        for i in range(len(m)):
            if all(iou[i, j] < ALIKE for j in kept):
                kept.append(i)
        kept.sort(key=lambda i: -float(m[i].sum()))
        out = torch.zeros(gh * gw, dtype=torch.uint8, device=self.device)
        for n, i in enumerate(kept[:60], 1):
            out[m[i] > 0] = n
        return out.view(gh, gw).cpu().numpy()


def main():
    import onnxruntime as ort

    ap = argparse.ArgumentParser()
    ap.add_argument("--bundle", required=True)
    ap.add_argument("--out", required=True)
    args = ap.parse_args()
    at = lambda n: os.path.join(args.bundle, n)
    state = {part + "." + k: v for part in ("encoder", "decoder") for k, v in weights(at(f"mask_{part}.onnx")).items()}
    np.savez(os.path.join(args.out, "masks.npz"), **{k: v.numpy().astype(np.float16) for k, v in state.items()})
    net = Everything(args.out, torch.device("cpu")).net
    x, xy = torch.randn(1, 3, SIDE, SIDE), torch.rand(4, 1, 2) * SIDE
    with torch.no_grad():
        e = net.encoder(x)
        mine = net.decoder(e, xy, torch.ones(4, 1))[0]
    theirs = ort.InferenceSession(at("mask_encoder.onnx")).run(None, {"images": x.numpy()})[0]
    print("encoder", np.abs(e.numpy() - theirs).max(), "of", np.abs(theirs).max())
    logits = ort.InferenceSession(at("mask_decoder.onnx")).run(None, {"image_embeddings": theirs, "point_coords": xy.numpy(), "point_labels": np.ones((4, 1), np.float32)})[0]
    print("decoder", np.abs(mine.numpy() - logits).max(), "of", np.abs(logits).max())


if __name__ == "__main__":
    main()
