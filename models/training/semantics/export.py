"""Writes the trained semantic networks as ONNX into a bundle, weights in 8 bits, and checks them.

    python export.py --masks masks.pt --words words.pt --text text.pt --space space.pt \
        --tokenizer PACK/tokenizer.json --bundle models/embedded

A weight matrix is stored as int8 with one scale an output channel and a DequantizeLinear behind it; ONNX
Runtime folds the two when it opens the file, so nothing is slower. Prints the parity with PyTorch.
"""
import argparse
import hashlib
import os
import shutil

import numpy as np
import onnx
import onnxruntime as ort
import torch
from onnx import helper, numpy_helper

from masks_model import MaskNet
from towers import fold
from words_model import CONTEXT, SIDE, ImageTower, TextTower

MASK_SIDE = 512


def small(path, least=2048):
    """Initializers of `least` numbers and more become int8 with a scale a row (or a column of a MatMul)."""
    model = onnx.load(path)
    graph = model.graph
    users = {}
    for node in graph.node:
        for slot, name in enumerate(node.input):
            users.setdefault(name, []).append((node.op_type, slot))
    nodes, inits = [], []
    for init in graph.initializer:
        w = numpy_helper.to_array(init)
        if init.data_type != onnx.TensorProto.FLOAT or w.size < least or w.ndim < 2:
            inits.append(init)
            continue
        axis = w.ndim - 1 if all(op == "MatMul" for op, _ in users.get(init.name, [])) else 0
        if w.ndim == 2 and axis == 0 and any(op == "Gemm" for op, _ in users[init.name]):
            axis = 0
        rest = tuple(a for a in range(w.ndim) if a != axis)
        scale = np.maximum(np.abs(w).max(rest), 1e-12) / 127
        shape = [1] * w.ndim
        shape[axis] = -1
        q = np.clip(np.round(w / scale.reshape(shape)), -127, 127).astype(np.int8)
        inits += [numpy_helper.from_array(q, init.name + "_q"), numpy_helper.from_array(scale.astype(np.float32), init.name + "_s")]
        nodes.append(helper.make_node("DequantizeLinear", [init.name + "_q", init.name + "_s"], [init.name], axis=axis))
    del graph.initializer[:]
    graph.initializer.extend(inits)
    old = list(graph.node)
    del graph.node[:]
    graph.node.extend(nodes + old)
    model.doc_string = ""
    for node in graph.node:
        node.doc_string = ""
        del node.metadata_props[:]
    del graph.value_info[:]
    onnx.checker.check_model(model)
    onnx.save(model, path)


def write(net, args, path, inputs, outputs, dynamic):
    torch.onnx.export(net, args, path, input_names=inputs, output_names=outputs, dynamic_axes=dynamic, opset_version=17, dynamo=False)
    model = onnx.load(path)
    model.ir_version = 10
    onnx.save(model, path)
    small(path)
    run = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    got = run.run(None, {k: v.numpy() for k, v in zip(inputs, args)})
    want = net(*args)
    want = want if isinstance(want, tuple) else (want,)
    for name, a, b in zip(outputs, got, want):
        b = b.detach().numpy()
        print(f"{os.path.basename(path)} {name} {a.shape} max |difference| {np.abs(a - b).max():.4f} of {np.abs(b).max():.3f}, mean {np.abs(a - b).mean():.5f}")
    print(os.path.basename(path), os.path.getsize(path), "bytes, sha256", hashlib.sha256(open(path, "rb").read()).hexdigest(), flush=True)
    return run


def state(path, prefix=""):
    s = torch.load(path, map_location="cpu")
    return {k[len(prefix):]: v.float() if v.is_floating_point() else v for k, v in s.items() if k.startswith(prefix)}


@torch.no_grad()
def main():
    ap = argparse.ArgumentParser()
    for name in ["masks", "words", "text", "tokenizer"]:
        ap.add_argument("--" + name, help="left out: the bundle's file stays")
    ap.add_argument("--bundle", required=True)
    args = ap.parse_args()
    torch.manual_seed(0)
    at = lambda name: os.path.join(args.bundle, name)
    if args.masks:
        net = MaskNet(MASK_SIDE)
        net.load_state_dict(state(args.masks))
        net = fold(net.eval())
        picture = torch.randn(1, 3, MASK_SIDE, MASK_SIDE)
        embedding = net.encoder(picture)
        write(net.encoder, (picture,), at("mask_encoder.onnx"), ["images"], ["image_embeddings"], {})
        points = torch.rand(4, 2, 2) * MASK_SIDE
        labels = torch.tensor([[1.0, -1.0], [1.0, 1.0], [1.0, 0.0], [1.0, -1.0]])
        write(net.decoder, (embedding, points, labels), at("mask_decoder.onnx"), ["image_embeddings", "point_coords", "point_labels"], ["low_res_masks", "iou_predictions"],
              {"point_coords": {0: "prompts", 1: "points"}, "point_labels": {0: "prompts", 1: "points"}, "low_res_masks": {0: "prompts"}, "iou_predictions": {0: "prompts"}})
    if args.words:
        tower = ImageTower()
        tower.load_state_dict(state(args.words, "tower."))
        write(fold(tower.eval()), (torch.rand(2, 3, SIDE, SIDE) * 2 - 1,), at("image_tower.onnx"), ["images"], ["embeddings"], {"images": {0: "batch"}, "embeddings": {0: "batch"}})
    if args.text:
        text = TextTower()
        text.load_state_dict(state(args.text))
        ids = torch.randint(2, 8000, (3, CONTEXT))
        ids[1, 4:] = 0
        write(text.eval(), (ids,), at("text_tower.onnx"), ["input_ids"], ["embeddings"], {"input_ids": {0: "batch", 1: "tokens"}, "embeddings": {0: "batch"}})
    if args.tokenizer:
        shutil.copy(args.tokenizer, at("tokenizer.json"))
        print("tokenizer.json sha256", hashlib.sha256(open(at("tokenizer.json"), "rb").read()).hexdigest())
    print("all files", sum(os.path.getsize(at(f)) for f in os.listdir(args.bundle)) / 2**20, "MiB")


if __name__ == "__main__":
    main()
