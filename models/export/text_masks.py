"""SAM 3 (Meta; code: PyPI `transformers` 5) as the text_masks section of a bundle: a photo and a text to masks with scores.

    python text_masks.py --checkpoint FOLDER --out DIR      # a folder as Meta publishes it: model.safetensors, config.json, tokenizer.json
    python text_masks.py --random 1 --out DIR [--tiny --tokenizer FILE]

Two files: the image encoder, which runs once a photo and gives the three finest maps of its pyramid, and all that is behind
it with the text encoder, which runs once a text and photo. A mask's score is that of its query times that of the text's
presence, as `Sam3Processor.post_process_instance_segmentation` has it. --tiny makes the same network with few and narrow
layers, to try the export without the memory of 840 million weights.
"""
import os
import shutil
import sys

import torch
from transformers import Sam3Config, Sam3Model
from transformers.models.sam3.modeling_sam3 import Sam3VisionEncoderOutput

from common import TOLERANCES, arguments, entry, export, gap, hold, prepare, session, tokenizer_entry, weights_of, write_section

# Tokens of a text, and of how many the example has that the exporter traces.
CONTEXT, TRACED = 32, 5
FEATURES = ["fpn_fine", "fpn_middle", "fpn_coarse"]
TINY = {
    "vision_config": {
        "backbone_config": {"model_type": "sam3_vit_model", "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2, "num_attention_heads": 4, "image_size": 168,
                            "window_size": 6, "global_attn_indexes": [1], "pretrain_image_size": 84},
        "fpn_hidden_size": 32, "backbone_feature_sizes": [[48, 48], [24, 24], [12, 12]]},
    "text_config": {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2, "num_attention_heads": 4, "projection_dim": 32,
                    "max_position_embeddings": CONTEXT},
    "geometry_encoder_config": {"hidden_size": 32, "num_layers": 1, "num_attention_heads": 4, "intermediate_size": 64},
    "detr_encoder_config": {"hidden_size": 32, "num_layers": 2, "num_attention_heads": 4, "intermediate_size": 64},
    "detr_decoder_config": {"hidden_size": 32, "num_layers": 2, "num_attention_heads": 4, "intermediate_size": 64, "num_queries": 12},
    "mask_decoder_config": {"hidden_size": 32, "num_attention_heads": 4},
}


class Image(torch.nn.Module):
    """`[1,3,S,S]` to the maps of the pyramid that the rest reads, finest first."""

    def __init__(self, model):
        super().__init__()
        self.vision = model.vision_encoder

    def forward(self, images):
        return tuple(self.vision(images).fpn_hidden_states[:3])


class Find(torch.nn.Module):
    """Maps of a photo, `input_ids` and `attention_mask` `[1,T]` to logits of masks `[1,Q,h,w]` and their scores `[1,Q]`."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, fine, middle, coarse, input_ids, attention_mask):
        maps = (fine, middle, coarse, coarse)  # the network drops the last one
        place = self.model.vision_encoder.neck.position_encoding
        places = tuple(place(m.shape, m.device, m.dtype) for m in maps)
        seen = Sam3VisionEncoderOutput(fpn_hidden_states=maps, fpn_position_encoding=places)
        out = self.model(vision_embeds=seen, input_ids=input_ids, attention_mask=attention_mask)
        return out.pred_masks, out.pred_logits.sigmoid() * out.presence_logits.sigmoid()


def loaded(args):
    """The network, and the file of its tokenizer."""
    if args.checkpoint:
        model = Sam3Model.from_pretrained(args.checkpoint, attn_implementation="eager")
        return model.eval(), args.tokenizer or os.path.join(args.checkpoint, "tokenizer.json")
    if not args.tokenizer:
        sys.exit("--random needs --tokenizer: a tokenizer.json")
    config = Sam3Config(**TINY) if args.tiny else Sam3Config()
    config._attn_implementation = "eager"
    return Sam3Model(config).eval(), args.tokenizer


def examples(model, side):
    """Inputs, and what the whole network makes of them. Before the export: it leaves places in the network's caches that are not right."""
    made = []
    for tokens, padding in ((TRACED, 0), (2, 0), (7, 3)):
        images = torch.randn(1, 3, side, side)
        ids = torch.randint(1, model.config.text_config.vocab_size - 1, (1, tokens))
        ids = torch.cat([ids, torch.zeros(1, padding, dtype=ids.dtype)], 1)
        there = torch.cat([torch.ones(1, tokens), torch.zeros(1, padding)], 1).long()
        out = model(pixel_values=images, input_ids=ids, attention_mask=there)
        made.append((images, ids, there, out.pred_masks, out.pred_logits.sigmoid() * out.presence_logits.sigmoid()))
    return made


def check(made, image_path, find_path):
    """Both files, one behind the other, give what the whole network gives."""
    image_session, find_session = session(image_path), session(find_path)
    for images, ids, there, wanted_masks, wanted_scores in made:
        maps = image_session.run(None, {"images": images.numpy()})
        feeds = dict(zip(FEATURES, maps)) | {"input_ids": ids.numpy(), "attention_mask": there.numpy()}
        masks, scores = find_session.run(None, feeds)
        hold(f"masks of {ids.shape[1]} tokens", gap(masks, wanted_masks), 1e-3)
        hold(f"scores of {ids.shape[1]} tokens", gap(scores, wanted_scores), 1e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--tokenizer", help="a tokenizer.json; that of the checkpoint's folder where not given")
    ap.add_argument("--tiny", action="store_true", help="with --random: few and narrow layers")
    ap.add_argument("--half", action="store_true", help="files of f16")
    args = ap.parse_args()
    prepare(args)
    model, tokenizer = loaded(args)
    side = model.config.vision_config.backbone_config.image_size
    os.makedirs(args.out, exist_ok=True)
    image_path, find_path = (os.path.join(args.out, f"text_masks_{name}.onnx") for name in ("image", "find"))
    made = [] if args.skip_check or args.half else examples(model, side)
    images = torch.randn(1, 3, side, side)
    maps = Image(model)(images)
    export(Image(model), {"images": images}, image_path, FEATURES, half=args.half)
    tokens = {"input_ids": torch.randint(1, 400, (1, TRACED)), "attention_mask": torch.ones(1, TRACED, dtype=torch.long)}
    dynamic = {name: {1: "T"} for name in tokens}
    export(Find(model), dict(zip(FEATURES, maps)) | tokens, find_path, ["masks", "scores"], dynamic, half=args.half)
    check(made, image_path, find_path)
    words = os.path.join(args.out, "text_masks_tokenizer.json")
    shutil.copy(tokenizer, words)
    write_section(args, "text_masks", f"""
[text_masks]
licence = "SAM License"
source = "SAM 3, {weights_of(args)}"
size = {side}
mean = [0.5, 0.5, 0.5]
std = [0.5, 0.5, 0.5]
threshold = 0.5
tolerance = {TOLERANCES[args.half]}

[text_masks.image]
{entry(image_path)}
input = "images"
features = {str(FEATURES).replace("'", '"')}

[text_masks.find]
{entry(find_path)}
{tokenizer_entry(words, CONTEXT)}
input_ids = "input_ids"
attention_mask = "attention_mask"
masks = "masks"
scores = "scores"
""")


if __name__ == "__main__":
    main()
