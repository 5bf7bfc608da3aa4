"""What the exporters share: sections of a bundle, ONNX files with their hashes, parity with PyTorch.

An exporter makes one section of a bundle (`geometry`, `masks` or `image_text`). All other sections and their
files come from `--base`, so that exporters can follow one another on the same folder.
"""
import argparse
import hashlib
import os
import re
import shutil
import sys
import tempfile

import numpy as np
import onnx
import torch
from onnx import numpy_helper

OPSET = 17
# A protobuf file holds at most 2 GiB. Larger weights go into a second file beside it.
INLINE_BYTES_MAX = 1 << 30

# How much a device may differ from a CPU, in f32 and in f16: share of the answer, root of mean squares.
TOLERANCES = {False: 0.002, True: 0.02}
# Crops in one run, for a CPU and for a GPU.
BATCHES = {False: 16, True: 32}


def arguments(doc):
    """A parser with the options of every exporter."""
    ap = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--out", required=True, help="folder of the new bundle")
    ap.add_argument("--base", help="bundle that gives the other sections (default: OUT itself where it is one, else the embedded bundle)")
    weights = ap.add_mutually_exclusive_group(required=True)
    weights.add_argument("--checkpoint", help="file of the published weights")
    weights.add_argument("--random", type=int, metavar="SEED", help="the same network with random weights")
    ap.add_argument("--skip-check", action="store_true", help="do not compare the ONNX files with PyTorch")
    return ap


def sha256(path):
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def prepare(args):
    """Seeds PyTorch for random weights; no gradients, and no fused attention, which ONNX does not know."""
    torch.manual_seed(args.random or 0)
    torch.backends.mha.set_fastpath_enabled(False)
    torch.set_grad_enabled(False)


def export(model, inputs, path, output_names, dynamic=None, half=False):
    """Writes `model` as ONNX. `inputs` is name to example tensor; `dynamic` is tensor name to {axis: name}. With `half`
    the file computes in f16; its inputs and outputs stay f32."""
    data = path + ".data"
    # Over 2 GiB the exporter writes a file for each tensor: they go with the folder.
    with tempfile.TemporaryDirectory(dir=os.path.dirname(path)) as place:
        first = os.path.join(place, "first.onnx")
        torch.onnx.export(model, tuple(inputs.values()), first, input_names=list(inputs), output_names=output_names,
                          dynamic_axes=dynamic or {}, opset_version=OPSET, dynamo=False)
        graph = onnx.load(first)
    single_precision(graph.graph)
    if half:
        half_precision(graph.graph)
    size = sum(len(tensor.raw_data) for tensor in graph.graph.initializer)
    if os.path.exists(data):
        os.remove(data)
    if size > INLINE_BYTES_MAX:
        onnx.save_model(graph, path, save_as_external_data=True, all_tensors_to_one_file=True, location=os.path.basename(data), size_threshold=1024)
    else:
        onnx.save_model(graph, path)


def narrow(graph, wide, to):
    """Constants of the type `wide`, and casts to it, become those of the type `to`; graphs inside of nodes stay."""
    numbers = onnx.helper.tensor_dtype_to_np_dtype(to)

    def narrowed(tensor):
        if tensor.data_type == wide:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(numbers), tensor.name))

    for tensor in graph.initializer:
        narrowed(tensor)
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.TENSOR:
                narrowed(attribute.t)
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == wide:
                attribute.i = to


def single_precision(graph):
    """The exporter writes some arithmetic of whole numbers and fractions in f64; the networks are f32 all through."""
    narrow(graph, onnx.TensorProto.DOUBLE, onnx.TensorProto.FLOAT)
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                single_precision(attribute.g)
    # Types that the exporter noted; ONNX Runtime finds them again.
    del graph.value_info[:]


def half_precision(graph):
    """A graph of f32 computes in f16 between its inputs and outputs, which stay f32. Norms and softmax still add up
    in f32 there: ONNX Runtime's kernels do."""
    single, half = onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16
    narrow(graph, single, half)
    renamed = {}
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH or attribute.name in ("value_float", "value_floats"):
                sys.exit(f"{node.name}: {node.op_type} is not known in f16")
    weights = {tensor.name for tensor in graph.initializer}
    first, last = [], []
    for value in graph.input:
        if value.type.tensor_type.elem_type == single and value.name not in weights:
            renamed[value.name] = value.name + "/half"
            first.append(onnx.helper.make_node("Cast", [value.name], [renamed[value.name]], to=half, name=value.name + "/to_half"))
    for value in graph.output:
        if value.type.tensor_type.elem_type == single:
            renamed[value.name] = value.name + "/half"
            last.append(onnx.helper.make_node("Cast", [renamed[value.name]], [value.name], to=single, name=value.name + "/to_single"))
    for node in graph.node:
        node.input[:] = [renamed.get(name, name) for name in node.input]
        node.output[:] = [renamed.get(name, name) for name in node.output]
    nodes = [*first, *graph.node, *last]
    del graph.node[:]
    graph.node.extend(nodes)


def entry(path):
    """The lines of a manifest that name a file of the bundle."""
    lines = [f'file = "{os.path.basename(path)}"', f'sha256 = "{sha256(path)}"']
    if os.path.exists(path + ".data"):
        lines += [f'data = "{os.path.basename(path)}.data"', f'data_sha256 = "{sha256(path + ".data")}"']
    return "\n".join(lines)


def files_of(section):
    return re.findall(r'(?m)^(?:file|data|tokenizer) = "([^"]+)"', section)


def write_section(args, name, text):
    """Replaces section `name` (with its subsections) of the manifest; copies what the other sections need."""
    here = os.path.join(args.out, "bundle.toml")
    embedded = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "embedded")
    base = args.base or (args.out if os.path.exists(here) else embedded)
    with open(os.path.join(base, "bundle.toml")) as file:
        head, *sections = re.split(r"(?m)^(?=\[)", file.read())
    mine = re.compile(rf"\[{name}[\].]")
    kept = [section for section in sections if not mine.match(section)]
    if not os.path.samefile(base, args.out):
        for file in files_of("".join(kept)):
            shutil.copyfile(os.path.join(base, file), os.path.join(args.out, file))
    head = re.sub(r"(?m)^#.*\n", "", head)
    head = re.sub(r'(?m)^name = .*$', f'name = "{os.path.basename(os.path.abspath(args.out))}"', head)
    manifest = "".join([head, *kept]).rstrip() + "\n\n" + text.strip() + "\n"
    with open(here, "w") as file:
        file.write(manifest)
    used = set(files_of(manifest)) | {"bundle.toml"}
    for file in sorted(used):
        print(f"{file:32} {os.path.getsize(os.path.join(args.out, file)) / 2**20:10.2f} MiB")


def weights_of(args):
    """What a manifest calls the weights."""
    return os.path.basename(os.path.normpath(args.checkpoint)) if args.checkpoint else f"random weights, seed {args.random}"


def tokenizer_entry(path, context):
    """The lines of a manifest that name a tokenizer and how many tokens are read with it."""
    return f'tokenizer = "{os.path.basename(path)}"\ntokenizer_sha256 = "{sha256(path)}"\ncontext = {context}'


def write_towers(args, source, licence, dim, unknown, *, size, mean, std, resize, context, dense=None):
    """The section of two towers whose files are `image_tower.onnx`, `text_tower.onnx` and `tokenizer.json`. `dense` is
    the longer side of a whole photo in patches and a patch's side in pixels, where the image tower has features."""
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    photos = "" if dense is None else f"""
[image_text.image.dense]
output = "dense"
side = {dense[0] * dense[1]}
cell = {dense[1]}
weights = [[0.0, 1.0]]
"""
    write_section(args, "image_text", f"""
[image_text]
licence = "{licence}"
source = "{source}, {weights_of(args)}"
dim = {dim}
tau = 10.0
canon = ["object", "things", "stuff"]
coverage_floor = 0.0

[image_text.image]
{entry(at("image_tower.onnx"))}
input = "images"
output = "embeddings"
size = {size}
mean = {mean}
std = {std}
resize = "{resize}"
crop_margin = 0.0
batch = {BATCHES[args.half]}
tolerance = {TOLERANCES[args.half]}
{photos}
[image_text.text]
{entry(at("text_tower.onnx"))}
{tokenizer_entry(at("tokenizer.json"), context)}
unknown = "{unknown}"
input_ids = "input_ids"
output = "embeddings"
""")


def write_masks(args, at, section, size, batch=64):
    """The section of a mask network whose files are `mask_encoder.onnx` and `mask_decoder.onnx`; `section` has its own keys."""
    write_section(args, "masks", f"""
[masks]
{section.strip().format(weights=weights_of(args))}
licence = "Apache-2.0"
size = {size}
points_per_side = 32
points_per_batch = {batch}
stability_score_offset = 1.0
box_nms_thresh = 0.7

[masks.encoder]
{entry(at("mask_encoder.onnx"))}
input = "images"
output = "image_embeddings"

[masks.decoder]
{entry(at("mask_decoder.onnx"))}
""")


def gap(found, wanted):
    """Largest difference as a share of the largest value."""
    wanted = wanted.detach().numpy() if isinstance(wanted, torch.Tensor) else np.asarray(wanted)
    return float(np.abs(found - wanted).max() / max(np.abs(wanted).max(), 1e-30))


def hold(what, value, bound):
    """Prints a figure of the comparison with PyTorch and ends the program where it is over its bound."""
    print(f"{what}: {value:.2e} (at most {bound:.0e})")
    if not value <= bound:
        sys.exit(f"{what} differs from PyTorch by {value:.2e} of the largest value; at most {bound:.0e} is accepted")


def session(path):
    import onnxruntime

    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
