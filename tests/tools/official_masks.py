"""Compares our masks with those of Segment Anything's own everything-mode on the same networks.

    segsplat-lab masks SCENES --dump OUT [--bundle DIR]
    python3 official_masks.py OUT BUNDLE_DIR [--report FILE]
    python3 official_masks.py OUT BUNDLE_DIR --torch vit_b --random 1 --alike 0.99

OUT holds each photo as our networks saw it (PNG) and our masks before level choice and before the
one-mask-a-pixel rule (JSON). `SamAutomaticMaskGenerator` of the package `segment-anything` gets the
bundle's thresholds and its ONNX files behind the interface of its own model; with `--torch` its own
model on PyTorch, with the weights that `models/export/sam.py` exported (`--checkpoint`, or the
seed of `--random`). Needs segment-anything, torch, torchvision, onnxruntime, numpy, pillow.
"""
import argparse
import json
import pathlib
import time
import tomllib

import numpy as np
import onnxruntime
import torch
from PIL import Image
from segment_anything import SamAutomaticMaskGenerator, sam_model_registry
from segment_anything.modeling.sam import Sam


class OnnxSam(torch.nn.Module):
    """What `SamPredictor` asks of a model, answered by ONNX files with SAM's contract."""

    mask_threshold = 0.0
    image_format = "RGB"
    device = torch.device("cpu")
    postprocess_masks = Sam.postprocess_masks

    def __init__(self, folder, masks, threads):
        super().__init__()
        self.manifest = masks
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads

        def session(part):
            return onnxruntime.InferenceSession(str(folder / masks[part]["file"]), options,
                                                providers=["CPUExecutionProvider"])

        self.encoder, self.decoder = session("encoder"), session("decoder")
        self.image_encoder = torch.nn.Module()
        self.image_encoder.img_size = masks["size"]
        self.image_encoder.forward = self.encode
        self.prompt_encoder = Prompts()
        self.mask_decoder = self.decode
        self.features = {}

    def preprocess(self, x):
        """Sam.preprocess with the bundle's normalisation, which is for 0..1."""
        mean = torch.tensor(self.manifest["mean"]).view(-1, 1, 1)
        std = torch.tensor(self.manifest["std"]).view(-1, 1, 1)
        x = (x.float() / 255 - mean) / std
        height, width = x.shape[-2:]
        side = self.manifest["size"]
        return torch.nn.functional.pad(x, (0, side - width, 0, side - height))

    def encode(self, x):
        names = self.manifest["encoder"]
        further = names.get("features", [])
        wanted = [names["output"], *further]
        found = self.encoder.run(wanted, {names["input"]: x.numpy()})
        self.features = dict(zip(further, found[1:]))
        return torch.from_numpy(found[0])

    def decode(self, image_embeddings, image_pe, sparse_prompt_embeddings,
               dense_prompt_embeddings, multimask_output):
        del image_pe, dense_prompt_embeddings, multimask_output
        coords, labels = sparse_prompt_embeddings
        names = self.manifest["decoder"]
        def name(key):
            return names.get(key, key)
        inputs = {i.name: i for i in self.decoder.get_inputs()}
        fixed = inputs[name("point_coords")].shape
        batch = fixed[0] if isinstance(fixed[0], int) else len(coords)
        points = fixed[1] if isinstance(fixed[1], int) else 2
        masks, ious = [], []
        for at in range(0, len(coords), batch):
            # A padding point follows the one asked for, as PromptEncoder._embed_points adds it.
            xy, kind = coords[at:at + batch].numpy(), labels[at:at + batch].numpy()
            pad = points - xy.shape[1]
            xy = np.pad(xy, ((0, 0), (0, pad), (0, 0))).astype(np.float32)
            kind = np.pad(kind, ((0, 0), (0, pad)), constant_values=-1).astype(np.float32)
            feed = {name("image_embeddings"): image_embeddings.numpy(), name("point_coords"): xy,
                    name("point_labels"): kind, **self.features}
            for key, value in [("mask_input", None), ("has_mask_input", np.zeros(1, np.float32)),
                               ("orig_im_size", np.ones(2, np.float32))]:
                if name(key) in inputs:
                    shape = [n if isinstance(n, int) else 1 for n in inputs[name(key)].shape]
                    feed[name(key)] = np.zeros(shape, np.float32) if value is None else value
            mask, iou = self.decoder.run([name("low_res_masks"), name("iou_predictions")], feed)
            masks.append(torch.from_numpy(mask[:, self.manifest["levels"]]))
            ious.append(torch.from_numpy(iou[:, self.manifest["levels"]]))
        return torch.cat(masks), torch.cat(ious)


class Prompts(torch.nn.Module):
    """Hands the points on: the ONNX decoder embeds them itself."""

    def forward(self, points, boxes, masks):
        assert boxes is None and masks is None
        return points, None

    def get_dense_pe(self):
        return None


def ours(entry):
    """Masks of one road of a JSON file: column-major runs, the first of them outside."""
    masks = []
    for mask in entry["masks"]:
        flat = np.zeros(entry["width"] * entry["height"], bool)
        at, inside = 0, False
        for run in mask["counts"]:
            flat[at:at + run] = inside
            at, inside = at + run, not inside
        masks.append(flat.reshape(entry["width"], entry["height"]).T)
    return masks


def at_size(mask, height, width):
    """A mask on a coarser grid over the photo, at the photo's pixels."""
    rows = (np.arange(height) + .5) / height * mask.shape[0]
    columns = (np.arange(width) + .5) / width * mask.shape[1]
    return mask[rows.astype(int)][:, columns.astype(int)]


def best(left, right):
    """IoU of each mask of `left` with its best partner in `right`."""
    if not left:
        return np.zeros(0)
    if not right:
        return np.zeros(len(left))
    a = np.stack([m.ravel() for m in left]).astype(np.float32)
    b = np.stack([m.ravel() for m in right]).astype(np.float32)
    common = a @ b.T
    union = a.sum(1)[:, None] + b.sum(1)[None] - common
    return (common / np.maximum(union, 1)).max(1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("dump", type=pathlib.Path)
    parser.add_argument("bundle", type=pathlib.Path)
    parser.add_argument("--report", type=pathlib.Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--alike", type=float, default=0.95, help="IoU of masks that are the same")
    parser.add_argument("--torch", choices=["vit_b", "vit_l", "vit_h"], help="the model on PyTorch")
    parser.add_argument("--checkpoint", help="its weights")
    parser.add_argument("--random", type=int, default=0, help="its seed, without --checkpoint")
    args = parser.parse_args()
    masks = tomllib.loads((args.bundle / "bundle.toml").read_text())["masks"]
    assert masks["adapter"] == "sam", "only networks with SAM's signature fit its own code"
    if args.torch:
        torch.set_num_threads(args.threads)
        torch.manual_seed(args.random)
        model = sam_model_registry[args.torch](checkpoint=args.checkpoint).eval()
    else:
        model = OnnxSam(args.bundle, masks, args.threads)
    keys = ["points_per_side", "points_per_batch", "pred_iou_thresh", "stability_score_thresh",
            "stability_score_offset", "box_nms_thresh", "min_mask_region_area", "crop_n_layers",
            "crop_overlap_ratio", "crop_n_points_downscale_factor", "crop_nms_thresh"]
    defaults = dict(zip(keys, [32, 64, .8, .9, 1., .7, 0, 0, 512 / 1500, 1, .7]))
    generator = SamAutomaticMaskGenerator(model, **{k: masks.get(k, defaults[k]) for k in keys})
    rows = []
    for file in sorted(args.dump.glob("*.json")):
        entry = json.loads(file.read_text())
        photo = np.array(Image.open(file.with_suffix(".png")).convert("RGB"))
        start = time.perf_counter()
        official = [m["segmentation"] for m in generator.generate(photo)]
        seconds = time.perf_counter() - start
        row = {"photo": file.stem, "official": len(official), "official_s": seconds}
        for road, found in entry.items():
            mine = [at_size(m, *photo.shape[:2]) for m in ours(found)]
            there, back = best(official, mine), best(mine, official)
            row[road] = {"masks": len(mine), "alike": int((there >= args.alike).sum()),
                         "alike_back": int((back >= args.alike).sum()),
                         "iou": float(there.mean()) if len(there) else 1.,
                         "iou_back": float(back.mean()) if len(back) else 1.}
        rows.append(row)
        print(json.dumps(row), flush=True)
    if not rows:
        raise SystemExit(f"no photos in {args.dump}")
    total = {"photos": len(rows), "official": sum(r["official"] for r in rows),
             "official_s": sum(r["official_s"] for r in rows) / len(rows)}
    for road in [key for key, value in rows[0].items() if isinstance(value, dict)]:
        def add(key):
            return sum(r[road][key] for r in rows)
        total[road] = {"masks": add("masks"),
                       "official_found": add("alike") / max(total["official"], 1),
                       "ours_found": add("alike_back") / max(add("masks"), 1),
                       "iou": add("iou") / len(rows), "iou_back": add("iou_back") / len(rows)}
    print(json.dumps(total, indent=1))
    if args.report:
        args.report.write_text(json.dumps({"total": total, "photos": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
