"""EfficientSAM, official code, as the mask section of a bundle.

    git clone https://github.com/yformer/EfficientSAM
    python efficient_sam.py --repo EfficientSAM --model vits --checkpoint weights/efficient_sam_vits.pt --out DIR
    python efficient_sam.py --repo EfficientSAM --model vitt --random 1 --out DIR

The decoder takes any number of prompts of one point, in pixels of a square of 256, and gives three masks each.
"""
import os
import sys

import torch

from common import arguments, export, gap, hold, prepare, session, write_masks

SIDE, LOGITS = 1024, 256
MODELS = {"vitt": (192, 3), "vits": (384, 6)}


class Decoder(torch.nn.Module):
    def __init__(self, sam):
        super().__init__()
        self.sam = sam

    def forward(self, image_embeddings, point_coords, point_labels):
        return self.sam.predict_masks(image_embeddings, point_coords, point_labels, multimask_output=True, input_h=LOGITS, input_w=LOGITS)


def compare(sam, at):
    """Both files against the official predictor, with one prompt and with several."""
    image = torch.rand(1, 3, SIDE, SIDE)
    embedding = sam.get_image_embeddings(image)
    normal = (image - sam.pixel_mean) / sam.pixel_std
    hold("encoder", gap(session(at("mask_encoder.onnx")).run(None, {"images": normal.numpy()})[0], embedding), 1e-3)
    decoder = session(at("mask_decoder.onnx"))
    for count in (1, 5, 64):
        coords, labels = torch.rand(1, count, 1, 2) * LOGITS, torch.ones(1, count, 1)
        # The official call: points in pixels of the image.
        masks, iou = sam.predict_masks(embedding, coords * (SIDE / LOGITS), labels, True, SIDE, SIDE)
        found = decoder.run(None, {"image_embeddings": embedding.numpy(), "point_coords": coords.numpy(), "point_labels": labels.numpy()})
        hold(f"decoder, {count} prompts, masks", gap(found[0], masks), 1e-3)
        hold(f"decoder, {count} prompts, IoU", gap(found[1], iou), 1e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--repo", required=True, help="checkout of the official code")
    ap.add_argument("--model", required=True, choices=MODELS)
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    # This file's own name would hide the package.
    sys.path[0] = args.repo
    sys.modules.pop("efficient_sam", None)
    from efficient_sam.efficient_sam import build_efficient_sam

    sam = build_efficient_sam(*MODELS[args.model], checkpoint=args.checkpoint).eval()
    export(sam.image_encoder, {"images": torch.randn(1, 3, SIDE, SIDE)}, at("mask_encoder.onnx"), ["image_embeddings"])
    side = SIDE // 16
    example = {"image_embeddings": torch.randn(1, 256, side, side), "point_coords": torch.rand(1, 3, 1, 2) * LOGITS, "point_labels": torch.ones(1, 3, 1)}
    dynamic = {name: {1: "prompts"} for name in ("point_coords", "point_labels", "low_res_masks", "iou_predictions")}
    export(Decoder(sam), example, at("mask_decoder.onnx"), ["low_res_masks", "iou_predictions"], dynamic)
    if not args.skip_check:
        compare(sam, at)
    rows = lambda values: [round(float(v), 6) for v in values.flatten()]  # noqa: E731
    write_masks(args, at, f"""
adapter = "efficient_sam"
source = "EfficientSAM, {args.model}, {{weights}}"
mean = {rows(sam.pixel_mean)}
std = {rows(sam.pixel_std)}
levels = [0, 1, 2]
pred_iou_thresh = 0.7
stability_score_thresh = 0.9
""", SIDE)


if __name__ == "__main__":
    main()
