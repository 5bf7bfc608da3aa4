"""Segment Anything (PyPI `segment-anything` 1.0) as the mask section of a bundle.

    python sam.py --model vit_h --checkpoint sam_vit_h_4b8939.pth --out DIR
    python sam.py --model vit_b --random 1 --out DIR

Encoder and decoder are the official ones, with some products in another order; the decoder takes a batch of
prompts. The published ONNX script fixes the batch at one prompt. `--half` stores and computes both in f16. The
decoder's file also judges masks at the photo's pixels, so that a device gives bits and not logits back.
Levels are SAM's: 0 is the mask of several points, 1 to 3 are part, object and whole.
"""
import copy
import os

import numpy as np
import onnx
import torch
from segment_anything import sam_model_registry
from segment_anything.modeling import image_encoder
from torch.nn.functional import gelu, layer_norm

from common import TOLERANCES, arguments, export, gap, half_precision, hold, prepare, session, write_masks
from judge import with_judge

SIDE = 1024
MEAN, STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
# Prompts in one run, for a CPU and for a GPU.
BATCHES = {False: 64, True: 256}


class ChannelNorm(torch.nn.Module):
    """SAM's `LayerNorm2d` as one operator, whose sums are of f32 also where its tensors are not."""

    def __init__(self, norm):
        super().__init__()
        self.norm = norm

    def forward(self, x):
        n = self.norm
        return layer_norm(x.permute(0, 2, 3, 1), n.weight.shape, n.weight, n.bias, n.eps).permute(0, 3, 1, 2)


class FoldedAttention(torch.nn.Module):
    """SAM's attention of the encoder. The positions along both axes, `rel_h` and `rel_w`, are further channels of
    the queries, and the keys say there in which row and column they are: one product, not three passes over
    the largest tensor."""

    def __init__(self, attention):
        super().__init__()
        self.own = attention

    @staticmethod
    def offsets(size):
        places = torch.arange(size)
        return places[:, None] - places[None, :] + size - 1

    def forward(self, x):
        own, (batch, height, width, channels) = self.own, x.shape
        height, width, heads = int(height), int(width), own.num_heads
        if len(own.rel_pos_h) != 2 * height - 1 or len(own.rel_pos_w) != 2 * width - 1:
            raise SystemExit("the encoder's tables of positions are of another size")
        qkv = own.qkv(x).reshape(-1, height * width, 3, heads, channels // heads).permute(2, 0, 3, 1, 4)
        q, k, v = qkv.reshape(3, -1, height * width, channels // heads).unbind(0)
        by_row = q.reshape(-1, height, width, channels // heads)
        of_row = own.rel_pos_h[self.offsets(height)].transpose(1, 2)
        of_column = own.rel_pos_w[self.offsets(width)].transpose(1, 2)

        def product(batched, table):  # [i, B, j, c] x [i, c, k], one product for each i
            size, rows, others = batched.shape[0], batched.shape[1], batched.shape[2]
            return (batched.reshape(size, -1, channels // heads) @ table).reshape(size, rows, others, -1)

        rel_h = product(by_row.permute(1, 0, 2, 3), of_row).permute(1, 0, 2, 3).reshape(-1, height * width, height)
        rel_w = product(by_row.permute(2, 0, 1, 3), of_column).permute(1, 2, 0, 3).reshape(-1, height * width, width)
        rows = torch.eye(height).repeat_interleave(width, dim=0)
        columns = torch.eye(width).repeat(height, 1)
        place = torch.cat([rows, columns], dim=1).expand(k.shape[0], -1, -1)
        scores = torch.cat([q * own.scale, rel_h, rel_w], dim=2) @ torch.cat([k, place], dim=2).transpose(1, 2)
        found = (scores.softmax(dim=-1) @ v).reshape(-1, heads, height, width, channels // heads)
        return own.proj(found.permute(0, 2, 3, 1, 4).reshape(-1, height, width, channels))


def windows(x, size):
    """SAM's `window_partition`. Rows and columns of zeros are joined on: ONNX Runtime's `Pad` takes a third of the
    encoder's time on a GPU."""
    batch, height, width, channels = (int(n) for n in x.shape)
    down, across = -height % size, -width % size
    x = torch.cat([x, torch.zeros(batch, down, width, channels)], dim=1)
    x = torch.cat([x, torch.zeros(batch, height + down, across, channels)], dim=2)
    rows, columns = (height + down) // size, (width + across) // size
    cut = x.reshape(batch, rows, size, columns, size, channels).permute(0, 1, 3, 2, 4, 5)
    return cut.reshape(-1, size, size, channels), (height + down, width + across)


def encoder_of(sam):
    """The official encoder with the same weights, whose attention, norms and windows are of fewer or faster operators."""
    image_encoder.window_partition = windows
    encoder = copy.copy(sam.image_encoder)
    encoder._modules = dict(encoder._modules)
    encoder.neck = torch.nn.Sequential(*[ChannelNorm(m) if type(m).__name__ == "LayerNorm2d" else m for m in encoder.neck])
    blocks = []
    for block in encoder.blocks:
        block = copy.copy(block)
        block._modules = {**block._modules, "attn": FoldedAttention(block.attn)}
        blocks.append(block)
    encoder.blocks = torch.nn.ModuleList(blocks)
    return encoder


class Prompts(torch.nn.Module):
    """Points and their labels as tokens; f32 in every file, because the sines of places need it."""

    def __init__(self, sam):
        super().__init__()
        self.prompts, self.side = sam.prompt_encoder, sam.image_encoder.img_size

    def forward(self, coords, labels):
        code = self.prompts.pe_layer._pe_encoding((coords + 0.5) / self.side)
        labels = labels.unsqueeze(-1)
        code = code * (labels != -1) + self.prompts.not_a_point_embed.weight * (labels == -1)
        for i, embedding in enumerate(self.prompts.point_embeddings):
            code = code + embedding.weight * (labels == i)
        return code


def of_heads(rows, table):
    """`[P, T, heads * c]` times `[heads, c, d]`, a product for each head: `[P, heads * T, d]`, the tokens of a head together."""
    heads, width, _ = table.shape
    count, tokens = rows.shape[0], rows.shape[1]
    split = rows.reshape(count * tokens, heads, width).transpose(0, 1) @ table
    return split.unflatten(1, (count, tokens)).transpose(0, 1).reshape(count, heads * tokens, -1)


def tokens_see_image(attention, queries, placed, cells):
    """SAM's attention of tokens `[P, T, C]` to cells `[P or 1, N, C]`; `placed` are the cells with their places. The keys'
    matrix is multiplied with the few queries, and the values' matrix with the few mixtures, so that neither is applied to
    all cells. The keys' bias is the same for all cells and has no effect."""
    own, heads = attention, attention.num_heads
    channels = own.q_proj.weight.shape[0] // heads
    folded = of_heads(own.q_proj(queries) / channels**0.5, own.k_proj.weight.unflatten(0, (heads, channels)))
    mixed = (folded @ placed.transpose(1, 2)).softmax(dim=-1) @ cells
    count, tokens = queries.shape[0], queries.shape[1]
    by_head = mixed.unflatten(1, (heads, tokens)).transpose(0, 1).reshape(heads, count * tokens, -1)
    values = by_head @ own.v_proj.weight.unflatten(0, (heads, channels)).transpose(1, 2)
    values = values.transpose(0, 1).reshape(count, tokens, heads * channels) + own.v_proj.bias
    return own.out_proj(values)


def image_sees_tokens(attention, placed, keys, values):
    """SAM's attention of cells to tokens, without the last bias: the queries' matrix is multiplied with the few keys, and the
    last matrix with the few values."""
    own, heads = attention, attention.num_heads
    channels = own.q_proj.weight.shape[0] // heads
    tokens = keys.shape[1]
    keys = own.k_proj(keys) / channels**0.5
    folded = of_heads(keys, own.q_proj.weight.unflatten(0, (heads, channels)))
    bias = of_heads(keys, own.q_proj.bias.unflatten(0, (heads, channels)).unsqueeze(2))
    scores = placed @ folded.transpose(1, 2) + bias.transpose(1, 2)
    shares = scores.unflatten(2, (heads, tokens)).softmax(dim=-1).flatten(2)
    return shares @ of_heads(own.v_proj(values), own.out_proj.weight.transpose(0, 1).unflatten(0, (heads, channels)))


class SumNorm(torch.autograd.Function):
    """`layer_norm(x + skip + bias)` as one operator of ONNX Runtime; `skip` may be the same for all of the first axis."""

    @staticmethod
    def forward(ctx, x, skip, weight, shift, bias, epsilon):
        return layer_norm(x + skip + bias, weight.shape, weight, shift, epsilon)

    @staticmethod
    def symbolic(g, x, skip, weight, shift, bias, epsilon):
        return g.op("com.microsoft::SkipLayerNormalization", x, skip, weight, shift, bias, epsilon_f=epsilon)


def doubled(weight, x):
    """A transposed convolution of 2 x 2 and stride 2, without its bias: each cell makes four, `[R, c]` to `[4 R, c']`."""
    channels = weight.shape[1]
    return (x @ weight.permute(0, 2, 3, 1).reshape(-1, 4 * channels)).reshape(-1, channels)


class CentredNorm(torch.nn.Module):
    """The bias and the norm after a transposed convolution, whose weights are then `weight`: sums, products and one product
    of matrices, each of which goes over all rows once. ONNX Runtime's norms have a thread block for each row, and here rows
    are many and short. Weights and bias are centred over the channels, so that no row has a mean, and have the norm's own
    weight. The mean of the squares of eight rows is a product with eight columns: one column alone is slow on a GPU."""

    ROWS = 8

    def __init__(self, step, norm, before):
        super().__init__()
        # A weight that is next to nothing hides what its channel adds to the squares: then it comes after them.
        small = norm.weight.abs()
        early = norm.weight if small.min() * 32 > small.max() else torch.ones_like(norm.weight)
        centred = step.weight - step.weight.mean(dim=1, keepdim=True)
        bias = step.bias - step.bias.mean()
        # f16 holds squares of 0.01 to 255 well. Rows come from a norm, so their size is known: it becomes about 1, by a
        # power of two.
        size = centred.square() * (before.weight.square() + before.bias.square()).reshape(-1, 1, 1, 1)
        scale = 2.0 ** -torch.log2((size.sum(0).mean() + bias.square().mean()).sqrt()).round()
        self.register_buffer("weight", centred * early.reshape(1, -1, 1, 1) * scale)
        self.register_buffer("bias", (bias * early * scale).reshape(1, -1))
        self.register_buffer("late", (norm.weight / early).reshape(1, -1))
        self.register_buffer("shift", norm.bias.reshape(1, -1))
        self.register_buffer("means", torch.block_diag(*[1 / (len(early) * early.square()).reshape(-1, 1)] * self.ROWS))
        self.whole = bool((self.late == 1).all())
        self.epsilon = max(float(norm.eps * scale**2), 2.0**-20)

    def forward(self, x):
        x = x + self.bias
        squares = ((x * x).reshape(-1, self.means.shape[0]) @ self.means).reshape(-1, 1)
        x = x * (squares + self.epsilon).sqrt().reciprocal()
        return (x if self.whole else x * self.late) + self.shift


class Decoder(torch.nn.Module):
    """`SamOnnxModel` without former masks and without enlarging, for any number of prompts, in an order that goes over the
    cells of all prompts less often. What is the same for all prompts is computed once, and both steps of the enlarging
    are products of matrices, channels last."""

    def __init__(self, sam):
        super().__init__()
        self.masks, self.side = sam.mask_decoder, sam.image_encoder.img_size // 16
        first, norm = sam.mask_decoder.output_upscaling[:2]
        self.first = CentredNorm(first, norm, sam.mask_decoder.transformer.layers[-1].norm4)
        self.register_buffer("places", sam.prompt_encoder.get_dense_pe().flatten(2).permute(0, 2, 1))
        self.register_buffer("dense", sam.prompt_encoder.no_mask_embed.weight)

    def transformed(self, cells, tokens):
        """SAM's two-way transformer: tokens `[P, T, C]`, cells `[P, N, C]`."""
        own, found = self.masks.transformer, tokens
        for layer in own.layers:
            placed = cells + self.places
            if layer.skip_first_layer_pe:
                found = layer.norm1(layer.self_attn(found, found, found))
            else:
                at = found + tokens
                found = layer.norm1(found + layer.self_attn(at, at, found))
            found = layer.norm2(found + tokens_see_image(layer.cross_attn_token_to_image, found + tokens, placed, cells))
            found = layer.norm3(found + layer.mlp(found))
            attention, norm = layer.cross_attn_image_to_token, layer.norm4
            more = image_sees_tokens(attention, placed, found + tokens, found)
            cells = SumNorm.apply(more, cells, norm.weight, norm.bias, attention.out_proj.bias, norm.eps)
        last = tokens_see_image(own.final_attn_token_to_image, found + tokens, cells + self.places, cells)
        return own.norm_final_attn(found + last), cells

    def forward(self, image_embeddings, prompt_tokens):
        m, side, count = self.masks, self.side, prompt_tokens.shape[0]
        tokens = torch.cat([m.iou_token.weight, m.mask_tokens.weight]).unsqueeze(0).expand(count, -1, -1)
        tokens = torch.cat((tokens, prompt_tokens), dim=1)
        hidden, cells = self.transformed(image_embeddings.flatten(2).permute(0, 2, 1) + self.dense, tokens)
        second = m.output_upscaling[3]
        # A bias of two axes: with one, ONNX Runtime makes one operator of it and GELU, which takes four times as long on a GPU.
        fine = gelu(self.first(doubled(self.first.weight, cells.reshape(count * side * side, -1))))
        fine = gelu(doubled(second.weight, fine) + second.bias.reshape(1, -1))
        rows = [m.output_hypernetworks_mlps[i](hidden[:, 1 + i]) for i in range(m.num_mask_tokens)]
        masks = fine.reshape(count, 16 * side * side, -1) @ torch.stack(rows, dim=2)
        masks = masks.reshape(count, side, side, 2, 2, 2, 2, m.num_mask_tokens).permute(0, 7, 1, 3, 5, 2, 4, 6)
        return masks.reshape(count, m.num_mask_tokens, 4 * side, 4 * side), m.iou_prediction_head(hidden[:, 0])


def export_decoder(sam, path, half):
    """Prompts, decoder and judge as one file."""
    part = lambda name: f"{path}.{name}"  # noqa: E731
    side = sam.image_encoder.img_size
    coords, labels = torch.rand(3, 2, 2) * side, torch.tensor([[1.0, -1.0]]).repeat(3, 1)
    dynamic = lambda *names: {name: {0: "prompts"} for name in names}  # noqa: E731
    export(Prompts(sam), {"point_coords": coords, "point_labels": labels}, part("prompts"), ["prompt_tokens"],
           dynamic("point_coords", "point_labels", "prompt_tokens"))
    example = {"image_embeddings": torch.randn(1, 256, side // 16, side // 16), "prompt_tokens": Prompts(sam)(coords, labels)}
    export(Decoder(sam), example, part("decoder"), ["low_res_masks", "iou_predictions"],
           dynamic("prompt_tokens", "low_res_masks", "iou_predictions"))
    prompts, decoder = onnx.load(part("prompts")), onnx.load(part("decoder"))
    if half:
        half_precision(decoder.graph)
    onnx.compose.add_prefix(prompts, "prompts/", rename_inputs=False, rename_outputs=False, inplace=True)
    prompts.ir_version = decoder.ir_version
    both = onnx.compose.merge_models(prompts, decoder, [("prompt_tokens", "prompt_tokens")])
    onnx.save_model(with_judge(both, side // 4), path)
    os.remove(part("prompts")), os.remove(part("decoder"))


def compare(args, sam, at):
    """Both files against the official modules, with one prompt and with several; the judge against NumPy."""
    bound = 0.05 if args.half else 1e-3
    image = torch.randn(1, 3, SIDE, SIDE)
    embedding = sam.image_encoder(image)
    found = session(at("mask_encoder.onnx")).run(None, {"images": image.numpy()})[0]
    hold("encoder", gap(found, embedding), bound)
    decoder = session(at("mask_decoder.onnx"))
    rows, columns = torch.rand(30, SIDE // 4).softmax(1), torch.rand(SIDE // 4, 45).softmax(0)
    for count in (1, 5, 64):
        coords = torch.rand(count, 2, 2) * SIDE
        labels = torch.tensor([[1.0, -1.0]]).repeat(count, 1)
        coords[:, 1] = 0
        sparse, dense = sam.prompt_encoder(points=(coords[:, :1], labels[:, :1]), boxes=None, masks=None)
        masks, iou = sam.mask_decoder.predict_masks(embedding, sam.prompt_encoder.get_dense_pe(), sparse, dense)
        # A threshold between the values, so that both sides have some.
        offset = float((rows @ masks @ columns).abs().median())
        feed = {"image_embeddings": embedding.numpy(), "point_coords": coords.numpy(), "point_labels": labels.numpy(),
                "judged_levels": np.array([3, 1]), "photo_rows": rows.numpy(), "photo_columns": columns.numpy(),
                "stability_offset": np.array([offset], np.float32)}
        found = decoder.run(None, feed)
        hold(f"decoder, {count} prompts, masks", gap(found[0], masks), bound)
        hold(f"decoder, {count} prompts, IoU", gap(found[1], iou), bound)
        pixels = (rows.numpy() @ found[0][:, [3, 1]] @ columns.numpy()).reshape(count, 2, -1)
        bits = np.unpackbits(found[2], axis=2, bitorder="little")
        wrong = (bits[..., : pixels.shape[2]] != (pixels > 0)).mean() + bits[..., pixels.shape[2] :].sum()
        hold(f"decoder, {count} prompts, pixels that differ", float(wrong), 1e-3)
        counts = np.stack([(pixels > offset).sum(2), (pixels > -offset).sum(2)], axis=2)
        hold(f"decoder, {count} prompts, counts", float(np.abs(found[3] - counts).max() / pixels.shape[2]), 2e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--model", required=True, choices=["vit_b", "vit_l", "vit_h"])
    ap.add_argument("--half", action="store_true", help="f16: half of the size, and several times as fast on a GPU")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    sam = sam_model_registry[args.model](checkpoint=args.checkpoint).eval()
    image = {"images": torch.randn(1, 3, SIDE, SIDE)}
    export(encoder_of(sam), image, at("mask_encoder.onnx"), ["image_embeddings"], half=args.half)
    export_decoder(sam, at("mask_decoder.onnx"), args.half)
    if not args.skip_check:
        compare(args, sam, at)
    write_masks(args, at, f"""
adapter = "sam"
source = "segment-anything 1.0, {args.model}, {{weights}}"
mean = {[round(v / 255, 7) for v in MEAN]}
std = {[round(v / 255, 7) for v in STD]}
levels = [1, 2, 3]
pred_iou_thresh = 0.88
stability_score_thresh = 0.95
tolerance = {TOLERANCES[args.half]}
""", SIDE, BATCHES[args.half])


if __name__ == "__main__":
    main()
