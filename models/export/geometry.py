"""MVSplat or DepthSplat, official code, as the geometry section of a bundle.

    git clone https://github.com/donydchen/mvsplat && git clone https://github.com/cvg/depthsplat
    python geometry.py mvsplat --repo mvsplat --checkpoint re10k.ckpt --out DIR
    python geometry.py depthsplat --repo depthsplat --checkpoint depthsplat-gs-small-re10k-256x256-view2-cfeab6b1.pth --out DIR
    python geometry.py depthsplat --repo depthsplat --dinov2 dinov2 --random 1 --size 448 768 --views 4 --out DIR

The number of views and the size are fixed in the file: the official code counts views in Python. DepthSplat loads
the code of DINOv2 by `torch.hub`; `--dinov2` names a checkout instead.
"""
import os

import torch

import official
from common import arguments, entry, export, gap, hold, prepare, session, write_section

NETWORKS = {
    # near, far: what the published weights were trained with, in units of RealEstate10K.
    "mvsplat": {"near": 1.0, "far": 100.0, "licence": "MIT (code); weights: see the repository"},
    "depthsplat": {"near": 0.5, "far": 100.0, "licence": "MIT (code); weights: see the repository"},
}
# RealEstate10K scales each sequence so that its near content lies at 1.25 units (Zhou et al. 2018, section 4), and the
# server's measured near has a margin before that content: it becomes 1.
# Both networks know that unit: DepthSplat's scales are absolute, and both look for depths between near and far.
NEAR_CONTENT = 1.0
# Largest differences to the official code, shares of the largest value.
BOUNDS = {"means": 1e-4, "covariances": 1e-3, "opacities": 1e-3, "harmonics": 1e-3}
# Packages of the official code for training and pictures alone.
UNUSED = ["wandb", "moviepy", "svg", "colorspacious", "matplotlib", "cv2", "skvideo", "imageio", "pytorch_lightning", "plyfile", "lpips",
          "skimage", "diff_gaussian_rasterization"]


def configuration(name, args):
    """The `model.encoder` of the repository's own experiment, as its dataclasses."""
    from dacite import Config, from_dict
    from omegaconf import OmegaConf

    read = lambda *path: OmegaConf.load(os.path.join(args.repo, "config", *path))  # noqa: E731
    encoder = {"mvsplat": "costvolume", "depthsplat": "depthsplat"}[name]
    merged = OmegaConf.merge(read("model", "encoder", encoder + ".yaml"), read("experiment", "re10k.yaml").model.encoder,
                             OmegaConf.from_dotlist(args.set))
    return lambda kind: from_dict(kind, OmegaConf.to_container(merged), Config(check_types=False))


def build(name, args):
    """The official encoder."""
    official.on_path(args.repo, UNUSED)
    views = {"mode": "test", "dataset": {"view_sampler": {"num_context_views": args.views}}}
    from omegaconf import OmegaConf

    make = configuration(name, args)
    if name == "mvsplat":
        from src import global_cfg
        global_cfg.set_cfg(OmegaConf.create(views))
        from src.model.encoder.encoder_costvolume import EncoderCostVolume as Encoder, EncoderCostVolumeCfg as Cfg
    else:
        if args.dinov2:
            load = torch.hub.load
            torch.hub.load = lambda _, model, **kw: load(args.dinov2, model, source="local", pretrained=False)
        from src.model.encoder.encoder_depthsplat import EncoderDepthSplat as Encoder, EncoderDepthSplatCfg as Cfg

    encoder = Encoder(make(Cfg)).eval()
    if args.checkpoint:
        state = torch.load(args.checkpoint, map_location="cpu", weights_only=False)
        state = state.get("state_dict", state.get("model", state))
        state = {key.removeprefix("encoder."): value for key, value in state.items() if not key.startswith(("losses", "decoder"))}
        encoder.load_state_dict(state)
    else:
        # What training starts at 0 (harmonics, scales) would hide a fault.
        for weight in encoder.parameters():
            weight += 0.02 * torch.randn_like(weight) * (weight == 0)
    return encoder


def compare(encoder, context, inputs, at, wanted):
    """The file against the official encoder: its Gaussians, and covariances from scales and quaternions. What is over
    its bound is held to the official code in f64: it may be three times as far from it as PyTorch's own f32."""
    found = dict(zip(official.OUTPUTS, session(at("geometry.onnx")).run(None, {k: v.numpy() for k, v in inputs.items()})))
    rows = lambda name: torch.from_numpy(found[name]).flatten(0, 2)  # noqa: E731
    kept = slice(-rows("means").shape[0], None)
    sh = rows("sh").transpose(-1, -2)
    ours = {"means": rows("means"), "covariances": official.covariance(rows("scales").double(), rows("quats").double()),
            "opacities": rows("opacities"), "harmonics": sh}
    of = lambda name, all: getattr(all, name)[0, kept][..., : sh.shape[-1] if name == "harmonics" else None].double()  # noqa: E731
    exact = None
    for name, mine in ours.items():
        off = gap(mine.double().numpy(), of(name, wanted))
        if off > BOUNDS[name]:
            exact = exact or official.gaussians(encoder, context, double=True)
            to_exact, theirs = gap(mine.double().numpy(), of(name, exact)), gap(of(name, wanted).numpy(), of(name, exact))
            print(f"{name}: {off:.2e} from PyTorch's f32, which is {theirs:.2e} from its own f64")
            hold(f"{name}, to f64", to_exact, max(BOUNDS[name], 3 * theirs))
        else:
            hold(name, off, BOUNDS[name])
    rest = wanted.harmonics[0, kept][..., sh.shape[-1] :]
    if rest.numel():
        print(f"bands over {official.DEGREE_MAX} are cut: at most {float(rest.abs().sum(-1).max()):.1e} of a colour")


def main():
    ap = arguments(__doc__)
    ap.add_argument("network", choices=NETWORKS)
    ap.add_argument("--repo", required=True, help="checkout of the official code")
    ap.add_argument("--dinov2", help="checkout of facebookresearch/dinov2")
    ap.add_argument("--size", type=int, nargs=2, default=[256, 256], metavar=("HEIGHT", "WIDTH"))
    ap.add_argument("--views", type=int, default=2)
    ap.add_argument("--world", action="store_true", help="poses are in the units of the training already, as RealEstate10K's own are")
    ap.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="changes of the encoder's configuration, as in the model zoo")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    at = lambda name: os.path.join(args.out, name)  # noqa: E731
    prepare(args)
    known = NETWORKS[args.network]
    encoder = build(args.network, args)
    images = torch.rand(args.views, 3, *args.size)
    inputs = dict(zip(official.INPUTS, (images, *official.cameras(args.views, known["near"], known["far"]))))
    if not args.skip_check:
        one = {"image": images[None], "intrinsics": inputs["intrinsics"][None], "extrinsics": inputs["camera_to_world"][None],
               "near": inputs["near"][None], "far": inputs["far"][None]}
        wanted = official.gaussians(encoder, one)
    with official.exportable():
        export(official.Graph(encoder), inputs, at("geometry.onnx"), official.OUTPUTS)
    if not args.skip_check:
        compare(encoder, one, inputs, at, wanted)
    degree = min(encoder.cfg.gaussian_adapter.sh_degree, official.DEGREE_MAX)
    source = args.checkpoint or f"random weights, seed {args.random}"
    write_section(args, "geometry", f"""
[geometry]
{entry(at("geometry.onnx"))}
licence = "{known["licence"]}"
source = "{args.network}, {os.path.basename(source)}"
buckets = [[{args.size[0]}, {args.size[1]}]]
views_min = {args.views}
views_max = {args.views}
neighbors_max = {args.views - 1}
sh_degree = {degree}
output_frame = "model"
translation = {'"world"' if args.world else f"{{ near = {NEAR_CONTENT} }}"}
near_far = [{known["near"]}, {known["far"]}]
resize = "lanczos"
mean = [0.0, 0.0, 0.0]
std = [1.0, 1.0, 1.0]

[geometry.inputs]
images = "images"
intrinsics = "intrinsics"
camera_to_world = "camera_to_world"
near = "near"
far = "far"

[geometry.outputs]
means = "means"
scales = "scales"
quats = "quats"
opacities = "opacities"
sh = "sh"
""")


if __name__ == "__main__":
    main()
