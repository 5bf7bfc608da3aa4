"""CLIP (PyPI `open_clip_torch`) as the image-text section of a bundle.

    python clip.py --model ViT-B-16 --checkpoint open_clip_pytorch_model.bin --out DIR     # laion2b_s34b_b88k
    python clip.py --model ViT-B-16 --random 1 --out DIR

`--half` writes the image tower in f16, for a GPU. The tokenizer is CLIP's byte-pair encoding, written as a `tokenizer.json` of the `tokenizers` library. It is held
to OpenCLIP's own tokenizer on the phrases of `phrases()`.
"""
import gzip
import os

import open_clip
import torch
from torch.nn.functional import linear, normalize
from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, processors

from common import arguments, export, hold, prepare, session, write_towers

BEGIN, END = "<|startoftext|>", "<|endoftext|>"
WORDS = r"""<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"""
CONTEXT = 77


class ImageTower(torch.nn.Module):
    def __init__(self, clip):
        super().__init__()
        self.clip = clip

    def forward(self, images):
        return self.clip.encode_image(images, normalize=True)


class Attention(torch.nn.Module):
    """`MultiheadAttention` over the whole sequence, with fewer operators: PyTorch's export of it is 40 nodes of
    shapes, of which ONNX Runtime brings some back to the CPU, and in f16 the CPU provider of its release 1.31 ends
    with a segmentation fault when it optimises them (`NchwcTransformer`)."""

    def __init__(self, own):
        super().__init__()
        self.own = own

    def forward(self, query, key, value, need_weights=False, attn_mask=None):
        own, length = self.own, int(query.shape[1])
        every = linear(query, own.in_proj_weight, own.in_proj_bias)
        heads = every.reshape(-1, length, 3, own.num_heads, own.head_dim).permute(2, 0, 3, 1, 4)
        q, k, v = heads.unbind(0)
        found = (q * own.head_dim**-0.5 @ k.transpose(2, 3)).softmax(dim=-1) @ v
        return own.out_proj(found.transpose(1, 2).reshape(-1, length, own.embed_dim)), None


class TextTower(torch.nn.Module):
    def __init__(self, clip):
        super().__init__()
        self.clip = clip

    def forward(self, ids):
        return self.clip.encode_text(ids, normalize=True)


def tokenizer():
    """CLIP's vocabulary and merges, as OpenCLIP packs them."""
    from open_clip.tokenizer import bytes_to_unicode, default_bpe

    with gzip.open(default_bpe()) as file:
        merges = file.read().decode().split("\n")[1 : 49152 - 256 - 2 + 1]
    merges = [tuple(line.split()) for line in merges]
    letters = list(bytes_to_unicode().values())
    words = letters + [letter + "</w>" for letter in letters] + ["".join(pair) for pair in merges] + [BEGIN, END]
    vocabulary = {word: i for i, word in enumerate(words)}
    made = Tokenizer(models.BPE(vocab=vocabulary, merges=merges, continuing_subword_prefix="", end_of_word_suffix="</w>", fuse_unk=False))
    made.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Replace(Regex(r"\s+"), " "), normalizers.Lowercase()])
    made.pre_tokenizer = pre_tokenizers.Sequence([
        pre_tokenizers.Split(Regex(WORDS), behavior="removed", invert=True), pre_tokenizers.ByteLevel(add_prefix_space=False)])
    made.decoder = decoders.ByteLevel()
    made.add_special_tokens([BEGIN, END])
    made.post_processor = processors.TemplateProcessing(
        single=f"{BEGIN} $A {END}", special_tokens=[(BEGIN, vocabulary[BEGIN]), (END, vocabulary[END])])
    return made


def phrases():
    """1,000 phrases: things, colours, places, numbers, punctuation, accents."""
    things = ["chair", "coffee mug", "game controller", "T-shirt", "dog's bed", "café table", "potted plant", "fire hydrant", "100 W lamp",
              "remote-control", "sofa (grey)", "3D printer", "sœur", "Übergröße", "wine glass, half full", "it's a box", "window & curtain",
              "picture of a fox", "stack of books!", "ping-pong ball"]
    kinds = ["red", "small", "the old wooden", "A  shiny", "two", "Blue", "somebody's", "no. 7", "left-most", "biggest"]
    places = ["", " on the desk", " in the corner", " near the door?", " under 2 windows"]
    return [f"{kind} {thing}{place}" for thing in things for kind in kinds for place in places]


def compare(args, clip, made, at):
    official = open_clip.get_tokenizer(args.model)
    texts = phrases()
    wanted = official(texts, context_length=CONTEXT)
    made.enable_padding(length=CONTEXT, pad_id=0)
    ids = torch.tensor([e.ids for e in made.encode_batch(texts)])
    hold(f"tokens of {len(texts)} phrases that differ", float((ids != wanted).any(1).sum()), 0)
    some = ids[::40]
    rows = torch.from_numpy(session(at("text_tower.onnx")).run(None, {"input_ids": some.numpy()})[0])
    hold("texts: 1 - cosine", float(1 - (rows * clip.encode_text(wanted[::40], normalize=True)).sum(1).min()), 1e-4)
    images = torch.randn(4, 3, *clip.visual.image_size)
    rows = torch.from_numpy(session(at("image_tower.onnx")).run(None, {"images": images.numpy()})[0])
    rows = normalize(rows)  # in f16 a length of 1 is not exact
    hold("images: 1 - cosine", float(1 - (rows * clip.encode_image(images, normalize=True)).sum(1).min()), 1e-4)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--model", default="ViT-B-16", help="a model of open_clip.list_models()")
    ap.add_argument("--half", action="store_true", help="the image tower in f16")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    clip = open_clip.create_model(args.model, pretrained=args.checkpoint).eval()
    made = tokenizer()
    made.save(at("tokenizer.json"))
    side = clip.visual.image_size[0]
    if args.half:
        for block in clip.visual.transformer.resblocks:
            block.attn = Attention(block.attn)
    export(ImageTower(clip), {"images": torch.randn(2, 3, side, side)}, at("image_tower.onnx"), ["embeddings"],
           {"images": {0: "crops"}, "embeddings": {0: "crops"}}, half=args.half)
    example = open_clip.get_tokenizer(args.model)(["a photo of a fox", "a box"], context_length=CONTEXT)
    export(TextTower(clip), {"input_ids": example}, at("text_tower.onnx"), ["embeddings"],
           {"input_ids": {0: "texts"}, "embeddings": {0: "texts"}})
    if not args.skip_check:
        compare(args, clip, made, at)
    write_towers(args, f"open_clip_torch {open_clip.__version__}, {args.model}", "MIT (OpenCLIP); weights: see their model card", clip.encode_text(example).shape[1],
                 END, size=side, mean=[round(v, 8) for v in clip.visual.image_mean], std=[round(v, 8) for v in clip.visual.image_std], resize="bicubic", context=CONTEXT)


if __name__ == "__main__":
    main()
