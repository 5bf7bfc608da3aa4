"""Makes weights of Segment Anything that need no download and whose masks lie at their prompts.

    python3 local_sam.py OUT.pth [--model vit_b] [--seed 1] [--sharpness 60]

Random weights give masks that are all alike and cover the photo: box NMS leaves one of them. Here
some weights of the prompts and of the decoder are set, so that everything-mode can be compared with
SAM's published settings. In the last attention from the image to the tokens a pixel attends to the
prompt by its distance. The rows that are multiplied with the pixels are fitted to discs of three
radii around 48 prompts, and the predicted IoU is brought to 0.93 with a deviation of 0.03. The
encoder and all other layers are as they were drawn.
"""
import argparse

import torch
from segment_anything import sam_model_registry

# Pixels of the square of 1024; the first is the mask of several points.
RADII = (90, 64, 90, 130)
PAIRS = 8
SCALE = 1.4
PROMPTS = 48
SHARPNESS = 60.0


def attend_by_distance(sam):
    """Pixels attend by `sum cos(2 pi f (x - x'))`; each head has eight frequencies f."""
    decoder, prompts = sam.mask_decoder, sam.prompt_encoder
    first, last = decoder.transformer.layers
    attention = last.cross_attn_image_to_token
    lengths = prompts.pe_layer.positional_encoding_gaussian_matrix.norm(dim=0)
    count = attention.num_heads * PAIRS
    skipped = (len(lengths) - count) // 2
    # The frequencies of middle length, dealt to the heads in turn.
    heads = lengths.argsort()[skipped : skipped + count].view(PAIRS, -1).T
    heads = torch.cat([heads, heads + len(lengths)], dim=1)
    for tokens in (decoder.iou_token, decoder.mask_tokens, prompts.not_a_point_embed,
                   *prompts.point_embeddings):
        tokens.weight[:, heads.flatten()] = 0
    # What a pixel takes from the prompt is the same at every place.
    prompts.point_embeddings[1].weight *= 4
    # The first layer replaces the tokens by what they attend to: each attends to itself.
    for name, scale in [("q_proj", 1.5), ("k_proj", 1.5), ("v_proj", 1.0), ("out_proj", 1.0)]:
        part = getattr(first.self_attn, name)
        part.weight.copy_(scale * torch.eye(len(part.bias)))
        part.bias.zero_()
    first.norm4.weight *= 0.05
    for part in (attention.q_proj, attention.k_proj):
        part.weight.zero_()
        part.bias.zero_()
        part.weight[torch.arange(heads.numel()), heads.flatten()] = SCALE
    attention.out_proj.weight *= 20
    # The four pixels that each step of the enlarging makes of one are alike.
    for step in (decoder.output_upscaling[0], decoder.output_upscaling[3]):
        step.weight.copy_(step.weight[..., :1, :1].expand_as(step.weight))


def fit(sam, sharpness=SHARPNESS):
    """Fits the masks' rows and the predicted IoU on random prompts and a random embedding."""
    decoder, side = sam.mask_decoder, sam.image_encoder.img_size
    embedding = torch.randn(1, 256, side // 16, side // 16)
    points = torch.rand(PROMPTS, 1, 2) * side
    labels = torch.ones(PROMPTS, 1)
    sparse, dense = sam.prompt_encoder(points=(points, labels), boxes=None, masks=None)
    pixels, scores, hooks = [], [], []
    for part, to in [(decoder.output_upscaling, pixels), (decoder.iou_prediction_head, scores)]:
        hooks.append(part.register_forward_hook(lambda _, __, out, to=to: to.append(out)))
    places = sam.prompt_encoder.get_dense_pe()
    for some in torch.arange(PROMPTS).split(16):
        decoder.predict_masks(embedding, places, sparse[some], dense[some])
    for hook in hooks:
        hook.remove()
    scores = torch.cat(scores)
    features = torch.cat(pixels).permute(0, 2, 3, 1)
    cells = (torch.arange(features.shape[1]) + 0.5) * side / features.shape[1]
    across = cells[None, None, :] - points[..., :1]
    away = torch.hypot(across, cells[None, :, None] - points[..., 1:])
    rows = features.reshape(-1, features.shape[-1]).double()
    for mlp, radius in zip(decoder.output_hypernetworks_mlps, RADII):
        wanted = ((radius - away) / radius).clamp(-1, 1).reshape(-1).double()
        # Cells inside are few: together they count as much as those outside.
        near = wanted > -1
        weight = torch.where(near, ((~near).sum() / near.sum()) ** 0.5, 1.0)[:, None]
        scaled = torch.linalg.lstsq(rows * weight, wanted[:, None] * weight, driver="gelsd")
        fitted = scaled.solution[:, 0]
        found = rows @ fitted > 0
        common = (found & (wanted > 0)).sum() / (found | (wanted > 0)).sum()
        print(f"radius {radius}: IoU with the discs {float(common):.2f}")
        mlp.layers[-1].weight *= 0.01
        mlp.layers[-1].bias[:] = sharpness * fitted
    head = decoder.iou_prediction_head.layers[-1]
    scale = 0.03 / scores.std(dim=0)
    head.bias[:] = 0.93 + (head.bias - scores.mean(dim=0)) * scale
    head.weight *= scale[:, None]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out")
    parser.add_argument("--model", default="vit_b", choices=["vit_b", "vit_l", "vit_h"])
    parser.add_argument("--seed", type=int, default=1)
    # More of it, more masks are stable enough.
    parser.add_argument("--sharpness", type=float, default=SHARPNESS)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    torch.set_grad_enabled(False)
    sam = sam_model_registry[args.model]().eval()
    attend_by_distance(sam)
    fit(sam, args.sharpness)
    torch.save(sam.state_dict(), args.out)


if __name__ == "__main__":
    main()
