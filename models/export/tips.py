"""TIPS and TIPSv2 (Google DeepMind; code: GitHub `google-deepmind/tips`) as the image_text section of a bundle, with features of whole photos.

    python tips.py --code FOLDER --variant B --checkpoint VISION.npz --texts TEXT.npz --tokenizer tokenizer.model --out DIR
    python tips.py --code FOLDER --random 1 --out DIR [--tiny] [--tokenizer FILE]

FOLDER is a copy of that repository, by any name. The image tower has two outputs: `embeddings` is its first token (`--token 2`: the second), `dense` is what its
last block makes of each patch's value alone, as the repository's notebook of zero-shot segmentation does. The photo's sides are free;
the places of patches are interpolated as the repository does, with a filter as wide as a place where there are fewer patches. `--half` writes the image
tower in f16, for a GPU. `--tokenizer` is SentencePiece's file, or a tokenizer.json; without it (and `--random`) a small one is trained on
a few words. --tiny makes the same network with few and narrow layers.
"""
import functools
import importlib.util
import io
import os
import sys
import types

import numpy as np
import sentencepiece
import torch
from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers
from torch.nn.functional import linear

from common import arguments, export, gap, hold, prepare, session, write_towers

# Longer side of a whole photo, in patches.
CELLS = 36
CONTEXT = 64
WORDS = 32_000
SIZES = {  # the repository's name of the image tower; of the text tower width, hidden width, heads, layers
    "S": ("vit_small", 384, 1536, 6, 12),
    "B": ("vit_base", 768, 3072, 12, 12),
    "L": ("vit_large", 1024, 4096, 16, 12),
    "So400m": ("vit_so400m", 1152, 4304, 16, 27),
    "g": ("vit_giant2", 1536, 6144, 24, 12),
}
PHRASES = ["a photo of a fox", "Box", "the  red chair on the table", "potted plant, near the door?", "3D printer", "café", "teddy bear's"]


def code_of(folder):
    """The two modules of the repository. Its text module asks TensorFlow for a tokenizer alone, which is not needed here."""
    for name in ("tensorflow", "tensorflow_text"):
        sys.modules.setdefault(name, types.ModuleType(name))
    made = []
    for name in ("image_encoder", "text_encoder"):
        path = os.path.join(folder, "pytorch", name + ".py")
        if not os.path.exists(path):
            sys.exit(f"{folder}: no pytorch/{name}.py; give a copy of the repository google-deepmind/tips")
        spec = importlib.util.spec_from_file_location("tips_" + name, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        made.append(module)
    return made


def triangles(cells, places):
    """`[cells, places]` weights of a bilinear filter along one axis, as wide as a cell where cells are larger than places; `cells` may be traced."""
    step = places / cells
    at = (torch.arange(cells) + 0.5) * step - 0.5
    wide = torch.clamp(torch.ones(()) * step, min=1.0)
    weights = torch.clamp(1 - (torch.arange(places)[None] - at[:, None]).abs() / wide, min=0)
    return weights / weights.sum(1, keepdim=True)


class ImageTower(torch.nn.Module):
    """`[B,3,H,W]` to embeddings `[B,dim]` and features `[B,dim,H/patch,W/patch]`."""

    def __init__(self, model, token):
        super().__init__()
        self.model, self.token, self.patch = model, token, model.patch_size
        self.side = round((model.pos_embed.shape[1] - 1) ** 0.5)

    def places(self, rows, columns):
        grid = self.model.pos_embed[0, 1:].reshape(self.side, self.side, -1)
        down, across = triangles(rows, self.side), triangles(columns, self.side)
        return torch.einsum("rh,hwd,cw->rcd", down, grid, across).reshape(1, -1, grid.shape[2])

    def heads(self, attention, x):
        """Query, key and value of each head, `[B,heads,N,width]`."""
        every = linear(x, attention.qkv.weight, attention.qkv.bias).reshape(x.shape[0], -1, 3, attention.num_heads, x.shape[2] // attention.num_heads)
        return every.permute(2, 0, 3, 1, 4).unbind(0)

    def rest(self, block, x, attended):
        merged = attended.transpose(1, 2).reshape(x.shape[0], -1, x.shape[2])
        x = x + block.ls1(block.attn.proj(merged))
        return x + block.ls2(block.mlp(block.norm2(x)))

    def forward(self, images):
        model = self.model
        rows, columns = images.shape[2] // self.patch, images.shape[3] // self.patch
        patches = model.patch_embed.proj(images).flatten(2).transpose(1, 2) + self.places(rows, columns)
        one = torch.ones_like(images[:, :1, :1, 0])
        first = one * (model.cls_token + model.pos_embed[:, :1])
        x = torch.cat([first, one * model.register_tokens, patches], 1)
        for at, block in enumerate(model.blocks):
            query, key, value = self.heads(block.attn, block.norm1(x))
            share = (query * block.attn.scale @ key.transpose(2, 3)).softmax(dim=-1)
            alone = self.rest(block, x, value) if at + 1 == len(model.blocks) else None
            x = self.rest(block, x, share @ value)
        skipped = 1 + model.num_register_tokens
        dense = model.norm(alone)[:, skipped:].transpose(1, 2)
        return model.norm(x)[:, self.token], dense.reshape(images.shape[0], x.shape[2], rows, columns)


class TextTower(torch.nn.Module):
    """`[B,T]` ids, 0 behind the text, to embeddings."""

    def __init__(self, model):
        super().__init__()
        self.model = model
        self.register_buffer("places", model.pos_embedder(seq_length=CONTEXT), persistent=False)

    def attended(self, attention, x, apart):
        every = linear(x, attention.in_proj_weight, attention.in_proj_bias)
        heads = every.reshape(x.shape[0], -1, 3, attention.num_heads, x.shape[2] // attention.num_heads).permute(2, 0, 3, 1, 4)
        query, key, value = heads.unbind(0)
        share = (query * (x.shape[2] // attention.num_heads) ** -0.5 @ key.transpose(2, 3) + apart).softmax(dim=-1)
        return attention.out_proj((share @ value).transpose(1, 2).reshape(x.shape[0], -1, x.shape[2]))

    def forward(self, ids):
        model, here = self.model, (ids != 0).float()[:, :, None]
        x = model.token_embedding(ids) * model.embedding_dim**0.5 + self.places[:, : ids.shape[1]]
        apart = (here[:, None, None, :, 0] - 1) * 1e9
        for block in model.transformer.resblocks:
            x = x + self.attended(block.attn, block.ln_1(x), apart)
            x = x + block.mlp.c_proj(torch.relu(block.mlp.c_fc(block.ln_2(x))) * here) * here
        return (model.ln_final(x) * here).sum(1) / (here.sum(1) + 1e-8)


def trained():
    """A small SentencePiece file."""
    out, text = io.BytesIO(), [f"{phrase} {number}" for phrase in PHRASES for number in range(40)]
    sentencepiece.SentencePieceTrainer.train(sentence_iterator=iter(text), model_writer=out, vocab_size=60, hard_vocab_limit=False, model_type="unigram", pad_id=0,
                                             unk_id=2, bos_id=-1, eos_id=1, minloglevel=2)
    return out.getvalue()


def tokenizer_of(model):
    """SentencePiece's file as one of `tokenizers`: small letters, nothing added, 0 behind the text."""
    from sentencepiece import sentencepiece_model_pb2

    proto = sentencepiece_model_pb2.ModelProto.FromString(model)
    if proto.trainer_spec.model_type != 1:
        sys.exit("the tokenizer is not SentencePiece's unigram")
    made = Tokenizer(models.Unigram([(piece.piece, piece.score) for piece in proto.pieces], proto.trainer_spec.unk_id, proto.trainer_spec.byte_fallback))
    own = [normalizers.Precompiled(proto.normalizer_spec.precompiled_charsmap)] if proto.normalizer_spec.precompiled_charsmap else []
    spaces = [normalizers.Replace(Regex(" {2,}"), " "), normalizers.Strip()] if proto.normalizer_spec.remove_extra_whitespaces else []
    made.normalizer = normalizers.Sequence([normalizers.Lowercase(), *own, *spaces])
    first = "first" if proto.normalizer_spec.add_dummy_prefix else "never"
    made.pre_tokenizer, made.decoder = pre_tokenizers.Metaspace(prepend_scheme=first, split=False), decoders.Metaspace(prepend_scheme=first)
    made.enable_padding(pad_id=0, pad_token=proto.pieces[0].piece)
    reader = sentencepiece.SentencePieceProcessor(model_proto=model)
    differing = sum(made.encode(text, add_special_tokens=False).ids != reader.encode(text.lower()) for text in PHRASES)
    hold(f"tokens of {len(PHRASES)} phrases that differ", float(differing), 0)
    return made, proto.pieces[proto.trainer_spec.unk_id].piece


def loaded(args):
    """Both networks as the repository makes them."""
    images, texts = code_of(args.code)
    name, width, hidden, heads, layers = SIZES[args.variant]
    common = dict(ffn_layer="swiglu" if args.variant == "g" else "mlp", block_chunks=0, init_values=1.0, interpolate_antialias=True, interpolate_offset=0.0)
    if args.tiny:
        width, hidden, heads, layers = 48, 96, 4, 2
        block = functools.partial(images.Block, attn_class=images.MemEffAttention)
        image = images.VisionTransformer(img_size=args.size, patch_size=14, embed_dim=width, depth=2, num_heads=4, qkv_bias=True, block_fn=block,
                                         num_register_tokens=1, **common)
    else:
        image = getattr(images, name)(img_size=args.size, **common)
    text = texts.TextEncoder({"hidden_size": width, "mlp_dim": hidden, "num_heads": heads, "num_layers": layers}, vocab_size=WORDS)
    if args.checkpoint:
        read = lambda path: {key: torch.from_numpy(value) for key, value in np.load(path, allow_pickle=False).items()}  # noqa: E731
        image.load_state_dict(read(args.checkpoint))
        text.load_state_dict({key: value for key, value in read(args.texts).items() if not key.startswith("temperature")})
    return image.eval(), text.eval()


def values_alone(model, images):
    """The features of patches as the repository's notebook makes them, by its own modules."""
    x = model.prepare_tokens_with_masks(images)
    for block in model.blocks[:-1]:
        x = block(x)
    block = model.blocks[-1]
    value = block.attn.qkv(block.norm1(x)).chunk(3, dim=-1)[2]
    x = x + block.ls1(block.attn.proj(value))
    x = x + block.ls2(block.mlp(block.norm2(x)))
    return model.norm(x)[:, 1 + model.num_register_tokens :]


def check(args, image, text, at):
    """Both files give what the repository's code gives."""
    tower, bound, side = session(at("image_tower.onnx")), 0.03 if args.half else 1e-3, args.size
    for height, width in ((side, side), (side + 28, side - 42), (side - 70, side + 14)):
        images = torch.rand(2, 3, height, width)
        found, whole = tower.run(None, {"images": images.numpy()}), image(images)
        wanted = whole[args.token - 1][:, 0]
        dense = values_alone(image, images).transpose(1, 2).reshape(found[1].shape)
        hold(f"embeddings of {height}x{width}", gap(found[0], wanted), bound)
        hold(f"features of {height}x{width}", gap(found[1], dense), bound)
    ids = torch.randint(1, 50, (3, 9))
    ids[1, 5:], ids[2, 1:] = 0, 0
    paddings = (ids == 0).int()
    found = session(at("text_tower.onnx")).run(None, {"input_ids": ids.numpy()})[0]
    hold("texts of 9, 5 and 1 tokens", gap(found, text(ids, paddings)), 1e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--code", required=True, help="a copy of the repository google-deepmind/tips")
    ap.add_argument("--variant", default="B", choices=list(SIZES))
    ap.add_argument("--texts", help="the text tower's checkpoint, .npz; --checkpoint is the image tower's")
    ap.add_argument("--tokenizer", help="SentencePiece's tokenizer.model, or a tokenizer.json")
    ap.add_argument("--size", type=int, default=448, help="side of the photos that the checkpoint was trained with: 448, or 224")
    ap.add_argument("--token", type=int, default=1, choices=[1, 2], help="which of the two tokens a cut is told by")
    ap.add_argument("--tiny", action="store_true", help="with --random: few and narrow layers")
    ap.add_argument("--half", action="store_true", help="the image tower in f16")
    args = ap.parse_args()
    if args.checkpoint and not (args.texts and args.tokenizer):
        sys.exit("--checkpoint is the image tower's and needs --texts and --tokenizer")
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    image, text = loaded(args)
    if args.random:
        # The repository begins with scales of 1 and places near 0, by which faults would hide.
        for weight in [*image.parameters(), *text.parameters()]:
            weight.add_(torch.randn_like(weight) * 0.05)
    if args.tokenizer and args.tokenizer.endswith(".json"):
        tokenizer, unknown = Tokenizer.from_file(args.tokenizer), None
        tokenizer.enable_padding(pad_id=0)
        unknown = next(token for token in ("<unk>", "[UNK]") if tokenizer.token_to_id(token) is not None)
    else:
        with open(args.tokenizer, "rb") if args.tokenizer else io.BytesIO(trained()) as file:
            tokenizer, unknown = tokenizer_of(file.read())
    tokenizer.save(at("tokenizer.json"))
    free = {"images": {0: "crops", 2: "height", 3: "width"}, "embeddings": {0: "crops"}, "dense": {0: "crops", 2: "rows", 3: "columns"}}
    export(ImageTower(image, args.token - 1), {"images": torch.rand(2, 3, args.size, args.size)}, at("image_tower.onnx"), ["embeddings", "dense"], free,
           half=args.half)
    export(TextTower(text), {"input_ids": torch.randint(1, 50, (2, 9))}, at("text_tower.onnx"), ["embeddings"],
           {"input_ids": {0: "texts", 1: "tokens"}, "embeddings": {0: "texts"}})
    if not args.skip_check:
        check(args, image, text, at)
    write_towers(args, f"TIPSv2 {args.variant}", "Apache-2.0 (code); weights: see their model card", image.embed_dim, unknown, size=args.size,
                 mean=[0.0] * 3, std=[1.0] * 3, resize="bilinear", context=CONTEXT, dense=(CELLS, image.patch_size))


if __name__ == "__main__":
    main()
