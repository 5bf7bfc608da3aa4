"""SigLIP and SigLIP 2 (Google; code: PyPI `transformers` 5) as the image_text section of a bundle, with features of whole photos.

    python siglip.py --checkpoint FOLDER --out DIR      # as Google publishes it for one size: model.safetensors, config.json, tokenizer.json, preprocessor_config.json
    python siglip.py --random 1 --out DIR --tokenizer FILE [--tiny]

The image tower has two outputs. `embeddings` is the pooled one. `dense` is what the pooling makes of each patch alone: of one key the
attention is 1, so it is the patch's value through the rest of the head, in the same space. The photo's sides are free; the places
of patches are interpolated as `transformers` does. `--half` writes the image tower in f16, for a GPU. --tiny makes the same network
with few and narrow layers. Checkpoints of free sizes (`naflex`) have another network and are refused.
"""
import json
import os
import sys

import torch
from tokenizers import Tokenizer, normalizers
from torch.nn.functional import linear
from transformers import SiglipConfig, SiglipModel

from common import arguments, export, gap, hold, prepare, session, write_towers

# Longer side of a whole photo, in patches.
CELLS = 36
# Pillow's numbers of filters.
FILTERS = {2: "bilinear", 3: "bicubic"}
TINY = {
    "vision_config": {"hidden_size": 48, "intermediate_size": 96, "num_hidden_layers": 2, "num_attention_heads": 4, "image_size": 64, "patch_size": 16},
    "text_config": {"hidden_size": 48, "intermediate_size": 96, "num_hidden_layers": 2, "num_attention_heads": 4, "max_position_embeddings": 64, "projection_size": 48},
}


class ImageTower(torch.nn.Module):
    """`[B,3,H,W]` to embeddings `[B,dim]` and features `[B,dim,H/patch,W/patch]`."""

    def __init__(self, model):
        super().__init__()
        self.vision, self.head = model.vision_model, model.vision_model.head
        self.patch = model.config.vision_config.patch_size

    def rest(self, attended):
        return attended + self.head.mlp(self.head.layernorm(attended))

    def forward(self, images):
        patches, attention = self.vision(pixel_values=images, interpolate_pos_encoding=True).last_hidden_state, self.head.attention
        # PyTorch's own attention is traced with the number of patches of the example.
        weights, biases = attention.in_proj_weight.chunk(3), attention.in_proj_bias.chunk(3)
        query, key, value = (linear(of, *by) for of, *by in zip((self.head.probe, patches, patches), weights, biases))
        split = lambda of: of.reshape(of.shape[0], -1, attention.num_heads, attention.head_dim).transpose(1, 2)  # noqa: E731
        share = (split(query) * attention.head_dim**-0.5 @ split(key).transpose(2, 3)).softmax(dim=-1)
        pooled = (share @ split(value)).transpose(1, 2).reshape(images.shape[0], attention.embed_dim)
        dense = self.rest(attention.out_proj(value)).transpose(1, 2)
        cells = images.shape[2] // self.patch, images.shape[3] // self.patch
        return self.rest(attention.out_proj(pooled)), dense.reshape(images.shape[0], attention.embed_dim, *cells)


class TextTower(torch.nn.Module):
    """`[B,T]` padded ids to embeddings. The network looks at padding too, as it was trained."""

    def __init__(self, model):
        super().__init__()
        self.text = model.text_model

    def forward(self, ids):
        return self.text(input_ids=ids).pooler_output


def tokenizer_of(path):
    """The tokenizer as these networks were trained with it: of small letters where it is SigLIP 2's, padded behind the text."""
    made = Tokenizer.from_file(path)
    pad = next((token for token in ("<pad>", "[PAD]", "</s>") if made.token_to_id(token) is not None), None)
    if pad is None:
        sys.exit(f"{path}: no token for padding")
    if pad == "<pad>":
        own = [made.normalizer] if made.normalizer is not None else []
        made.normalizer = normalizers.Sequence([normalizers.Lowercase(), *own])
    made.no_truncation()
    made.enable_padding(pad_id=made.token_to_id(pad), pad_token=pad)
    return made


def loaded(args):
    """The network, the file of its tokenizer, and how it takes photos."""
    tokenizer = args.tokenizer
    if not args.checkpoint:
        if not tokenizer:
            sys.exit("--random needs --tokenizer: a tokenizer.json")
        config = SiglipConfig(**TINY) if args.tiny else SiglipConfig()
        config.text_config.vocab_size = max(config.text_config.vocab_size, Tokenizer.from_file(tokenizer).get_vocab_size())
        config._attn_implementation = "eager"
        return SiglipModel(config).eval(), tokenizer, {}
    with open(os.path.join(args.checkpoint, "config.json")) as file:
        kind = json.load(file)["model_type"]
    if kind != "siglip":
        sys.exit(f"{args.checkpoint}: a checkpoint of {kind!r}; those for one size, of 'siglip', are read (SigLIP 2 has both)")
    with open(os.path.join(args.checkpoint, "preprocessor_config.json")) as file:
        photos = json.load(file)
    model = SiglipModel.from_pretrained(args.checkpoint, attn_implementation="eager").eval()
    return model, tokenizer or os.path.join(args.checkpoint, "tokenizer.json"), photos


def examples(model, context):
    """Inputs, and what the whole network makes of them: by its own calls, and of one patch by its own pooling."""
    side, patch = model.config.vision_config.image_size, model.config.vision_config.patch_size
    made = []
    for height, width in ((side, side), (side + patch, side - patch)):
        images = torch.randn(2, 3, height, width)
        out = model.vision_model(pixel_values=images, interpolate_pos_encoding=True)
        cells = [model.vision_model.head(out.last_hidden_state[:, k : k + 1]) for k in range(out.last_hidden_state.shape[1])]
        dense = torch.stack(cells, 2).reshape(2, -1, height // patch, width // patch)
        made.append((images, out.pooler_output, dense))
    plain = torch.randn(2, 3, side, side)
    hold("places of patches at the own size", gap(model.vision_model(pixel_values=plain, interpolate_pos_encoding=True).pooler_output.numpy(),
                                                   model.vision_model(pixel_values=plain).pooler_output), 1e-4)
    ids = torch.randint(1, 400, (2, context))
    return made, ids, model.text_model(input_ids=ids).pooler_output


def check(made, ids, texts, at, half):
    """Both files give what the network gives."""
    tower, bound = session(at("image_tower.onnx")), 0.03 if half else 1e-3
    for images, wanted, dense in made:
        found = tower.run(None, {"images": images.numpy()})
        shape = "x".join(map(str, images.shape[2:]))
        hold(f"embeddings of {shape}", gap(found[0], wanted), bound)
        hold(f"features of {shape}", gap(found[1], dense), bound)
    hold("texts", gap(session(at("text_tower.onnx")).run(None, {"input_ids": ids.numpy()})[0], texts), 1e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--tokenizer", help="a tokenizer.json; that of the checkpoint's folder where not given")
    ap.add_argument("--tiny", action="store_true", help="with --random: few and narrow layers")
    ap.add_argument("--half", action="store_true", help="the image tower in f16")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    model, tokenizer, photos = loaded(args)
    config, context = model.config.vision_config, model.config.text_config.max_position_embeddings
    tokenizer_of(tokenizer).save(at("tokenizer.json"))
    made = None if args.skip_check else examples(model, context)
    side = config.image_size
    free = {"images": {0: "crops", 2: "height", 3: "width"}, "embeddings": {0: "crops"}, "dense": {0: "crops", 2: "rows", 3: "columns"}}
    export(ImageTower(model), {"images": torch.randn(2, 3, side, side)}, at("image_tower.onnx"), ["embeddings", "dense"], free, half=args.half)
    export(TextTower(model), {"input_ids": torch.randint(1, 400, (2, context))}, at("text_tower.onnx"), ["embeddings"],
           {"input_ids": {0: "texts"}, "embeddings": {0: "texts"}})
    if made:
        check(*made, at, args.half)
    unknown = next(token for token in ("<unk>", "[UNK]", "<eos>") if Tokenizer.from_file(at("tokenizer.json")).token_to_id(token) is not None)
    write_towers(args, "SigLIP", "Apache-2.0", config.hidden_size, unknown, size=side, mean=photos.get("image_mean", [0.5, 0.5, 0.5]),
                 std=photos.get("image_std", [0.5, 0.5, 0.5]), resize=FILTERS[photos.get("resample", 2)], context=context, dense=(CELLS, config.patch_size))


if __name__ == "__main__":
    main()
