"""Depth Anything 3 (ByteDance; code: PyPI `depth-anything-3`) as the cameras section of a bundle: photos to their cameras and depths.

    python cameras.py --checkpoint model.safetensors --out DIR [--variant small]      # the file of DA3-SMALL or DA3-BASE, as its authors publish it
    python cameras.py --random 1 --out DIR [--variant small]

One file for any number of photos and any sides that are multiples of 14, all photos of one shape. A trace of the package keeps what it computes in
Python: the number of photos from which a photo is chosen that the others are told from, and all sizes. So the network's own modules are put together
here without: the photo is chosen in the graph, and places are computed from the shapes. The order of the photos stays: where the package puts the chosen
one first, only its token differs from those of the others. `--depth` adds depths and how sure they are.
"""
import os
from importlib.util import find_spec

import torch
from safetensors.torch import load_file
from torch.nn import functional

from common import arguments, entry, export, gap, hold, prepare, session, weights_of, write_section

# Longer side of a photo and side of a patch, pixels; most photos of a run.
SIDE, PATCH, VIEWS_MAX = 504, 14, 32
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
# Fewer photos are told from the first one (`THRESH_FOR_REF_SELECTION`).
CHOSEN_FROM = 3
# The package interpolates places with a scale that is a little larger than that of the sizes.
ASIDE = 0.1
CAMERAS, DEPTHS = ["extrinsics", "intrinsics"], ["depth", "depth_confidence"]


def number(length):
    """A size of a tensor, to compute with in a trace."""
    return torch.as_tensor(length).float()


def cubic(cells, places, scale):
    """`[cells, places]` weights of PyTorch's bicubic interpolation along one axis; `cells` and `scale` may be traced."""
    at = (torch.arange(cells) + 0.5) / scale - 0.5
    first = at.floor()
    off = (at - first)[:, None] - torch.arange(-1.0, 3.0)
    near, far = off.abs(), off.abs()
    weights = torch.where(near <= 1, (1.25 * near - 2.25) * near**2 + 1, ((-0.75 * far + 3.75) * far - 6) * far + 3)
    index = (first[:, None] + torch.arange(-1.0, 3.0)).clamp(0, places - 1)
    return (weights[:, :, None] * (index[:, :, None] == torch.arange(places))).sum(1)


def waves(at, numbers, base):
    """`[N, numbers]`: sines and cosines of places, as `make_sincos_pos_embed`."""
    turns = at[:, None] * base ** -(torch.arange(numbers // 2) / (numbers / 2))
    return torch.cat([turns.sin(), turns.cos()], 1)


class Cameras(torch.nn.Module):
    """`[V,3,H,W]` to extrinsics `[V,3,4]` (world to camera) and intrinsics `[V,3,3]` (pixels), and where asked for depths and their confidence `[V,H,W]`."""

    def __init__(self, model, depth):
        super().__init__()
        self.vit, self.layers = model.backbone.pretrained, model.backbone.out_layers
        self.cam_dec, self.head = model.cam_dec, model.head if depth else None
        self.side = round((self.vit.pos_embed.shape[1] - 1) ** 0.5)

    def places(self, rows, columns):
        whole = (torch.as_tensor(rows) == self.side) & (torch.as_tensor(columns) == self.side)
        aside = torch.where(whole, 0.0, ASIDE)
        grid = self.vit.pos_embed[0, 1:].reshape(self.side, self.side, -1)
        down, across = (cubic(cells, self.side, (number(cells) + aside) / self.side) for cells in (rows, columns))
        return torch.einsum("rh,hwd,cw->rcd", down, grid, across).reshape(1, -1, grid.shape[2])

    def turns(self, at):
        """Cosines and sines of the rotary embedding for `[N,2]` rows and columns."""
        width = self.vit.embed_dim // self.vit.num_heads // 2
        angles = at[:, :, None] * self.vit.rope.base_frequency ** -(torch.arange(0, width, 2) / width)
        angles = torch.cat([angles, angles], 2).flatten(1)
        return angles.cos(), angles.sin()

    def attended(self, attention, x, turns):
        every = attention.qkv(x).reshape(x.shape[0], -1, 3, attention.num_heads, x.shape[2] // attention.num_heads)
        query, key, value = every.permute(2, 0, 3, 1, 4).unbind(0)
        query, key = attention.q_norm(query), attention.k_norm(key)
        if turns is not None:
            query, key = (self.turned(part, turns) for part in (query, key))
        share = (query * attention.scale @ key.transpose(2, 3)).softmax(dim=-1)
        return attention.proj((share @ value).transpose(1, 2).reshape(x.shape))

    @staticmethod
    def turned(x, turns):
        a, b, c, d = x.chunk(4, 3)
        return x * turns[0] + torch.cat([-b, a, -d, c], 3) * turns[1]

    def block(self, block, x, turns):
        x = x + block.ls1(self.attended(block.attn, block.norm1(x), turns))
        return x + block.ls2(block.mlp(block.norm2(x)))

    def chosen(self, first, views):
        """The photo that the others are told from, by the first tokens `[V,dim]` of all (`saddle_balanced`)."""
        unit = first / first.norm(dim=1, keepdim=True)
        alike = ((unit @ unit.T).sum(1) - 1) / (number(views) - 1)
        def balanced(of):
            return ((of - of.min()) / (of.max() - of.min() + 1e-8) - 0.5).abs()
        off = balanced(alike) + balanced(first.norm(dim=1)) + balanced(unit.var(dim=1))
        return torch.where(torch.as_tensor(views) < CHOSEN_FROM, 0, off.argmin())

    def features(self, images):
        """Tokens `[V,1+patches,2*dim]` of each layer that is read: those of a photo alone beside those of all, as they are."""
        vit, (views, _, height, width) = self.vit, images.shape
        rows, columns = height // PATCH, width // PATCH
        x = vit.patch_embed.proj(images).flatten(2).transpose(1, 2) + self.places(rows, columns)
        x = torch.cat([(vit.cls_token + vit.pos_embed[:, :1]).expand(views, -1, -1), x], 1)
        down, across = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        at = torch.stack([down.flatten(), across.flatten()], 1) + 1.0
        at = torch.cat([torch.zeros(1, 2), at])
        own = self.turns(at)
        # Among all photos only first tokens and patches are told apart.
        shared = self.turns(at.clamp(max=1).repeat(views, 1))
        kept = []
        for index, block in enumerate(vit.blocks):
            rotary = index >= vit.rope_start
            if index == vit.alt_start - 1:
                reference = self.chosen(x[:, 0], views)
            if index == vit.alt_start:
                is_reference = (torch.arange(views) == reference)[:, None, None]
                x = torch.cat([torch.where(is_reference, vit.camera_token[:, :1], vit.camera_token[:, 1:]), x[:, 1:]], 1)
            if index >= vit.alt_start and index % 2 == 1:
                x = self.block(block, x.reshape(1, -1, x.shape[2]), shared if rotary else None).reshape(x.shape)
            else:
                x = alone = self.block(block, x, own if rotary else None)
            if index in self.layers:
                kept.append((alone, x))
        return kept

    def cameras(self, tokens, height, width):
        """Extrinsics and intrinsics of the first tokens `[V,2*dim]`."""
        encoded = self.cam_dec(tokens[None])[0]
        place, (i, j, k, r), (down, across) = encoded[:, :3], encoded[:, 3:7].unbind(1), encoded[:, 7:].unbind(1)
        two = 2 / (encoded[:, 3:7] ** 2).sum(1)
        turn = torch.stack([
            1 - two * (j * j + k * k), two * (i * j + k * r), two * (i * k - j * r),
            two * (i * j - k * r), 1 - two * (i * i + k * k), two * (j * k + i * r),
            two * (i * k + j * r), two * (j * k - i * r), 1 - two * (i * i + j * j)], 1).reshape(-1, 3, 3)
        extrinsics = torch.cat([turn, -turn @ place[:, :, None]], 2)
        halves = [number(side) / 2 + torch.zeros_like(across) for side in (width, height)]
        focal = [half / torch.clamp((angle / 2).tan(), min=1e-6) for half, angle in zip(halves, (across, down))]
        none, one = torch.zeros_like(across), torch.ones_like(across)
        intrinsics = torch.stack([focal[0], none, halves[0], none, focal[1], halves[1], none, none, one], 1)
        return extrinsics, intrinsics.reshape(-1, 3, 3)

    @staticmethod
    def placed(x, height, width):
        """Features `[V,C,h,w]` with a tenth of the waves of their places in the photo."""
        sides = (number(width), number(height))
        diagonal = (sides[0] ** 2 + sides[1] ** 2) ** 0.5
        half = x.shape[1] // 2
        both = []
        for side, count in zip(sides, (x.shape[3], x.shape[2])):
            at = side / diagonal * (2 * torch.arange(count) + 1 - number(count)) / number(count)
            both.append(waves(at, half, 100.0).T)
        across, down = both[0][:, None, :], both[1][:, :, None]
        nothing = torch.zeros_like(across) + torch.zeros_like(down)
        return x + 0.1 * torch.cat([across + nothing, down + nothing])[None]

    def depths(self, tokens, height, width):
        """Depths and their confidence, from the patches `[V,patches,2*dim]` of each layer (the first branch of `DualDPT`)."""
        head, parts, levels = self.head, self.head.scratch, []
        rows, columns = height // PATCH, width // PATCH
        for of_layer, project, resize in zip(tokens, head.projects, head.resize_layers):
            x = head.norm(of_layer).transpose(1, 2).reshape(-1, of_layer.shape[2], rows, columns)
            levels.append(resize(self.placed(project(x), height, width)))
        layers = [parts.layer1_rn, parts.layer2_rn, parts.layer3_rn, parts.layer4_rn]
        fine, second, third, coarse = (layer(level) for layer, level in zip(layers, levels))
        out = parts.refinenet4(coarse, size=third.shape[2:])
        out = parts.refinenet3(out, third, size=second.shape[2:])
        out = parts.refinenet2(out, second, size=fine.shape[2:])
        out = parts.refinenet1(out, fine, size=(2 * fine.shape[2], 2 * fine.shape[3]))
        out = functional.interpolate(parts.output_conv1(out), size=(rows * PATCH, columns * PATCH), mode="bilinear", align_corners=True)
        logits = parts.output_conv2(self.placed(out, height, width))
        return logits[:, 0].exp(), logits[:, 1].exp() + 1

    def forward(self, images):
        kept, (height, width) = self.features(images), images.shape[2:]
        found = self.cameras(torch.cat([part[:, 0] for part in kept[-1]], 1), height, width)
        if self.head is None:
            return found
        patches = [torch.cat([alone[:, 1:], self.vit.norm(x)[:, 1:]], 2) for alone, x in kept]
        return (*found, *self.depths(patches, height, width))


def loaded(args):
    """The package's network, of its own configuration, with the published weights or with random ones."""
    from depth_anything_3.cfg import create_object, load_config

    package = next(iter(find_spec("depth_anything_3").submodule_search_locations))
    model = create_object(load_config(os.path.join(package, "configs", f"da3-{args.variant}.yaml"))).eval()
    if args.checkpoint:
        weights = {name.removeprefix("model."): value for name, value in load_file(args.checkpoint).items()}
        model.load_state_dict(weights)
        return model
    # The package begins with places, tokens and scales of 0 and 1, by which faults would hide; angles and logarithms of depths stay about 1.
    for weight in model.parameters():
        weight.add_(torch.randn_like(weight) * 0.05)
    tame = 1.0 if args.variant == "small" else 0.02
    model.cam_dec.fc_fov[0].bias.fill_(1.0)
    model.head.scratch.output_conv2[2].weight.mul_(tame)
    model.cam_dec.fc_fov[0].weight.mul_(0.1 * tame)
    return model


def check(model, path, names):
    """The file gives what the package gives, whatever the number of photos and their shape."""
    onnx_session = session(path)
    # At 518x518 places are taken as they are.
    for height, width, counts in ((112, 154, (2, 3, 5, 8)), (210, 98, (2, 3, 5, 8)), (518, 518, (1,))):
        for views in counts:
            images = torch.randn(views, 3, height, width)
            wanted = model(images[None])
            found = onnx_session.run(None, {"images": images.numpy()})
            for name, value in zip(names, found):
                own = wanted["depth_conf" if name == "depth_confidence" else name][0]
                hold(f"{views} photos of {height}x{width}: {name}", gap(value, own), 1e-3)


def main():
    ap = arguments(__doc__)
    ap.add_argument("--variant", default="small", choices=["small", "base"])
    ap.add_argument("--depth", action="store_true", help="also depths and their confidence")
    args = ap.parse_args()
    prepare(args)
    model = loaded(args)
    os.makedirs(args.out, exist_ok=True)
    path, names = os.path.join(args.out, "cameras.onnx"), CAMERAS + (DEPTHS if args.depth else [])
    free = {"images": {0: "V", 2: "H", 3: "W"}, "extrinsics": {0: "V"}, "intrinsics": {0: "V"}} | {name: {0: "V", 1: "H", 2: "W"} for name in DEPTHS if args.depth}
    export(Cameras(model, args.depth).eval(), {"images": torch.randn(4, 3, 84, 126)}, path, names, free)
    if not args.skip_check:
        check(model, path, names)
    depths = 'depth = "depth"\ndepth_confidence = "depth_confidence"\n' if args.depth else ""
    write_section(args, "cameras", f"""
[cameras]
{entry(path)}
licence = "Apache-2.0"
source = "Depth Anything 3 {args.variant} (PyPI depth-anything-3 0.1.1), {weights_of(args)}"
input = "images"
world_to_camera = "extrinsics"
intrinsics = "intrinsics"
{depths}views_max = {VIEWS_MAX}
side = {SIDE}
cell = {PATCH}
mean = {MEAN}
std = {STD}
""")


if __name__ == "__main__":
    main()
