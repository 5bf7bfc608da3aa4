"""Weights to the bundle: ONNX with fp16-stored weights (cast to fp32 at load), and its parity.

    python export.py --weights ema.pt --out ../../embedded/geometry.onnx

Prints the largest difference to PyTorch fp32 with the same (fp16-rounded) weights, and what the
rounding itself changes.
"""
import argparse
import warnings

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from model import Exported, GeometryNet

AXES = {
    "images": {0: "V", 2: "H", 3: "W"}, "intrinsics": {0: "V"}, "camera_to_world": {0: "V"},
    "near": {0: "V"}, "far": {0: "V"}, "neighbors": {0: "V", 1: "N"},
}


def halve(path, least=256):
    """Stores every large fp32 initializer as fp16 behind a Cast; runtimes fold it at load."""
    m = onnx.load(path)
    keep, casts = [], []
    for t in m.graph.initializer:
        a = numpy_helper.to_array(t)
        if a.dtype == np.float32 and a.size >= least:
            h = numpy_helper.from_array(a.astype(np.float16), t.name + "_f16")
            casts.append(helper.make_node("Cast", [h.name], [t.name], to=TensorProto.FLOAT))
            keep.append(h)
        else:
            keep.append(t)
    nodes = list(m.graph.node)
    del m.graph.initializer[:], m.graph.node[:]
    m.graph.initializer.extend(keep)
    m.graph.node.extend(casts + nodes)
    onnx.checker.check_model(m)
    onnx.save(m, path)


def pad_channels(path):
    """Convolutions of 17 and 21 channels get channels of weight 0 up to a multiple of 4: ONNX Runtime's
    WebGPU provider 1.27 computes them wrong (docs/measurements/webgpu). The result is the same."""
    m = onnx.load(path)
    made = {o: n for n in m.graph.node for o in n.output}
    stored = {t.name: t for t in m.graph.initializer}
    nodes = []
    for n in m.graph.node:
        cast = made.get(n.input[1]) if n.op_type == "Conv" else None
        weight = stored.get(cast.input[0]) if cast is not None and cast.op_type == "Cast" else None
        grouped = any(a.name == "group" and a.i > 1 for a in n.attribute)
        if weight is not None and not grouped and weight.dims[1] % 4:
            w, joined = numpy_helper.to_array(weight), made[n.input[0]]
            more = -w.shape[1] % 4
            if joined.op_type != "Concat" or more != 3:
                raise SystemExit(f"{n.name}: {w.shape[1]} channels, which this cannot fill up")
            # One of the joined inputs has three channels: it is joined once more.
            three = joined.input[-1] if "r_in" in n.name else joined.input[0]
            wide = np.concatenate([w, np.zeros((w.shape[0], more, *w.shape[2:]), w.dtype)], 1)
            weight.CopyFrom(numpy_helper.from_array(wide, weight.name))
            nodes.append(helper.make_node("Concat", [*joined.input, three], [joined.output[0] + "_padded"], joined.name + "_padded", axis=1))
            n.input[0] = nodes[-1].output[0]
        nodes.append(n)
    del m.graph.node[:]
    m.graph.node.extend(nodes)
    onnx.checker.check_model(m)
    onnx.save(m, path)


def example(v, n, h, w, seed):
    """Textured input with a plausible rig."""
    g = torch.Generator().manual_seed(seed)
    img = torch.nn.functional.interpolate(torch.rand(v, 3, h // 8, w // 8, generator=g), (h, w), mode="bicubic").clamp(0, 1)
    K = torch.eye(3).repeat(v, 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, :2, 2] = 1.1, 1.1 * w / h, 0.5
    P = torch.eye(4).repeat(v, 1, 1)
    P[:, 0, 3] = torch.linspace(0, 1, v)
    nb = torch.tensor([[(i + 1 + j) % v for j in range(n)] for i in range(v)])
    return img, K, P, torch.full((v,), 3.0), torch.full((v,), 15.0), nb


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--weights", required=True)
    ap.add_argument("--out", required=True)
    args = ap.parse_args()
    warnings.filterwarnings("ignore")
    net = GeometryNet()
    net.load_state_dict({k: v.float() for k, v in torch.load(args.weights, map_location="cpu").items()})
    net.eval()
    wrapped = Exported(net)
    torch.onnx.export(wrapped, example(2, 1, 256, 256, 0), args.out, input_names=list(AXES), output_names=Exported.NAMES,
                      dynamic_axes=AXES, opset_version=17, dynamo=False)
    halve(args.out)
    pad_channels(args.out)

    import onnxruntime as ort

    session = ort.InferenceSession(args.out, providers=["CPUExecutionProvider"])
    for shape in [(2, 1, 256, 256), (3, 2, 256, 352), (4, 3, 224, 384), (8, 3, 128, 128)]:
        inputs = example(*shape, 1)
        got = session.run(None, {k: v.numpy() for k, v in zip(AXES, inputs)})
        with torch.no_grad():
            want = wrapped(*inputs)
        rel = {n: float(np.abs(g - w.numpy()).max() / (np.abs(w.numpy()).max() + 1e-9)) for n, g, w in zip(Exported.NAMES, got, want)}
        print("V,N,H,W", shape, "max |diff| / max |value|:", {k: f"{v:.1e}" for k, v in rel.items()})


if __name__ == "__main__":
    main()
