"""Segment Anything (PyPI `segment-anything` 1.0) as the mask section of a bundle.

    python sam.py --model vit_h --checkpoint sam_vit_h_4b8939.pth --out DIR
    python sam.py --model vit_b --random 1 --out DIR

The encoder is the official one. The decoder is the official one over a batch of prompts: the published ONNX
script fixes the batch at one prompt and enlarges every mask to the photo, which nothing here reads.
Levels are SAM's: 0 is the mask of several points, 1 to 3 are part, object and whole.
"""
import os

import torch
from segment_anything import sam_model_registry

from common import arguments, export, gap, hold, prepare, session, write_masks

SIDE = 1024
MEAN, STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


class Decoder(torch.nn.Module):
    """`SamOnnxModel` without former masks and without enlarging, for any number of prompts."""

    def __init__(self, sam):
        super().__init__()
        self.prompts, self.masks, self.side = sam.prompt_encoder, sam.mask_decoder, sam.image_encoder.img_size

    def points(self, coords, labels):
        code = self.prompts.pe_layer._pe_encoding((coords + 0.5) / self.side)
        labels = labels.unsqueeze(-1)
        code = code * (labels != -1) + self.prompts.not_a_point_embed.weight * (labels == -1)
        for i, embedding in enumerate(self.prompts.point_embeddings):
            code = code + embedding.weight * (labels == i)
        return code

    def forward(self, image_embeddings, point_coords, point_labels):
        sparse = self.points(point_coords, point_labels)
        count = sparse.shape[0]
        m = self.masks
        tokens = torch.cat([m.iou_token.weight, m.mask_tokens.weight]).unsqueeze(0).expand(count, -1, -1)
        dense = self.prompts.no_mask_embed.weight.reshape(1, -1, 1, 1)
        source = (image_embeddings + dense).expand(count, -1, -1, -1)
        places = self.prompts.get_dense_pe().expand(count, -1, -1, -1)
        hidden, source = m.transformer(source, places, torch.cat((tokens, sparse), dim=1))
        side = image_embeddings.shape[-1]
        source = source.transpose(1, 2).reshape(count, -1, side, side)
        enlarged = m.output_upscaling(source)
        rows = [m.output_hypernetworks_mlps[i](hidden[:, 1 + i]) for i in range(m.num_mask_tokens)]
        masks = (torch.stack(rows, dim=1) @ enlarged.flatten(2)).reshape(count, -1, 4 * side, 4 * side)
        return masks, m.iou_prediction_head(hidden[:, 0])


def compare(args, sam, at):
    """Both files against the official modules, with one prompt and with several."""
    image = torch.randn(1, 3, SIDE, SIDE)
    embedding = sam.image_encoder(image)
    found = session(at("mask_encoder.onnx")).run(None, {"images": image.numpy()})[0]
    hold("encoder", gap(found, embedding), 1e-3)
    decoder = session(at("mask_decoder.onnx"))
    for count in (1, 5, 64):
        coords = torch.rand(count, 2, 2) * SIDE
        labels = torch.tensor([[1.0, -1.0]]).repeat(count, 1)
        coords[:, 1] = 0
        sparse, dense = sam.prompt_encoder(points=(coords[:, :1], labels[:, :1]), boxes=None, masks=None)
        masks, iou = sam.mask_decoder.predict_masks(embedding, sam.prompt_encoder.get_dense_pe(), sparse, dense)
        feed = {"image_embeddings": embedding.numpy(), "point_coords": coords.numpy(), "point_labels": labels.numpy()}
        found = decoder.run(None, feed)
        hold(f"decoder, {count} prompts, masks", gap(found[0], masks), 1e-3)
        hold(f"decoder, {count} prompts, IoU", gap(found[1], iou), 1e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--model", required=True, choices=["vit_b", "vit_l", "vit_h"])
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    sam = sam_model_registry[args.model](checkpoint=args.checkpoint).eval()
    export(sam.image_encoder, {"images": torch.randn(1, 3, SIDE, SIDE)}, at("mask_encoder.onnx"), ["image_embeddings"])
    example = {"image_embeddings": torch.randn(1, 256, SIDE // 16, SIDE // 16), "point_coords": torch.rand(3, 2, 2) * SIDE,
               "point_labels": torch.tensor([[1.0, -1.0]]).repeat(3, 1)}
    dynamic = {name: {0: "prompts"} for name in ("point_coords", "point_labels", "low_res_masks", "iou_predictions")}
    export(Decoder(sam), example, at("mask_decoder.onnx"), ["low_res_masks", "iou_predictions"], dynamic)
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
""", SIDE)


if __name__ == "__main__":
    main()
