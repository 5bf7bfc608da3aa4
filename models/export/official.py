"""What the exporters of MVSplat and DepthSplat share: their encoders as graphs of the server's contract.

Both predict Gaussians in the frame of the given poses, with the harmonics rotated by `e3nn` as if their order
were x, y, z. The graph gives the same numbers in the model frame (the first camera of the set):

- means, opacities: as the official adapter gives them;
- scales and quaternions (w x y z): the factors of its covariances, the camera's rotation applied;
- harmonics: `[V, H, W, K, 3]`, rotated by the same matrices, which are computed without `e3nn`'s angles:
  with Y the harmonics of fixed directions X, `D = pinv(Y(X)) Y(X R)`, since `Y(R x) = D Y(x)`.
"""
import contextlib
import functools
import importlib.abc
import importlib.util
import sys

import torch

# The server's largest degree of harmonics; further bands are cut. MVSplat's fourth is scaled by 0.0004.
DEGREE_MAX = 3


class Unused(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives empty modules for packages of training and pictures that are not installed."""

    def __init__(self, packages):
        self.packages = {name for name in packages if importlib.util.find_spec(name) is None}

    def find_spec(self, name, path=None, target=None):
        return importlib.util.spec_from_loader(name, self, is_package=True) if name.split(".")[0] in self.packages else None

    def exec_module(self, module):
        module.__getattr__ = self.anything

    @staticmethod
    def anything(name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


def on_path(repo, unused):
    """Makes the checkout importable as `src`."""
    sys.path.insert(0, repo)
    sys.meta_path.append(Unused(unused))


def inverse(matrix):
    """Inverses that ONNX can say: 2x2 and 3x3 by cofactors, 4x4 as a rigid motion."""
    side = matrix.shape[-1]
    if side == 4:
        rotation = matrix[..., :3, :3].transpose(-1, -2)
        shift = -(rotation @ matrix[..., :3, 3:])
        return torch.cat([torch.cat([rotation, shift], -1), matrix[..., 3:, :]], -2)
    if side == 2:
        a, b, c, d = (matrix[..., i, j] for i in range(2) for j in range(2))
        rows = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
        return rows / (a * d - b * c)[..., None, None]
    a, b, c = matrix.unbind(-2)
    rows = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)
    return rows / (a * torch.linalg.cross(b, c)).sum(-1)[..., None, None]


@contextlib.contextmanager
def exportable():
    """The official code in words that ONNX has: its inverses, its rotation of harmonics, no checkpoints of gradients."""
    fixed_directions()  # not in the graph
    changed = [(torch, "inverse", inverse), (torch.Tensor, "inverse", inverse)]
    plainly = lambda function, inputs, *_: function(*inputs)  # noqa: E731
    for name, module in sys.modules.items():
        if name.startswith("src."):
            changed += [(module, "rotate_sh", rotate_harmonics)] if hasattr(module, "rotate_sh") else []
            changed += [(module, "checkpoint", plainly)] if hasattr(module, "checkpoint") else []
    kept = [(owner, name, getattr(owner, name)) for owner, name, _ in changed]
    for owner, name, value in changed:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in kept:
            setattr(owner, name, value)


def harmonics(degree, directions):
    """e3nn's harmonics of one degree, `[..., 2 degree + 1]`, by its own polynomials."""
    from e3nn.o3 import spherical_harmonics

    return spherical_harmonics(degree, directions, normalize=False, normalization="integral")


@functools.cache
def fixed_directions():
    """64 directions `[64, 3]`, and for each degree the pseudo-inverse `[2 degree + 1, 64]` of their harmonics."""
    directions = torch.nn.functional.normalize(torch.randn(64, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)), dim=-1)
    return directions.float(), {n: torch.linalg.pinv(harmonics(n, directions)).float() for n in range(1, DEGREE_MAX + 1)}


def turn(matrices, rows):
    """Each row `[..., k]` times its matrix `[..., k, k]`. Where all pixels of a view have one matrix, that is a product for each
    view: with one for each pixel a GPU took 11 of DepthSplat's 26 ms."""
    k = rows.shape[-1]
    if matrices.dim() != rows.dim() + 1 or any(side != 1 for side in matrices.shape[2:-2]):
        return (matrices @ rows[..., None])[..., 0]
    views = rows.shape[:2]
    return (rows.reshape(*views, -1, k) @ matrices.reshape(*views, k, k).transpose(-1, -2)).reshape(rows.shape)


def rotate_harmonics(coefficients, rotations):
    """`rotate_sh` of the official code for the bands that are kept; `[..., K]`, K up to 16."""
    directions, inverses = fixed_directions()
    bands, degree = [coefficients[..., :1]], 1
    while degree <= DEGREE_MAX and degree**2 < coefficients.shape[-1]:
        turned = harmonics(degree, directions @ rotations.transpose(-1, -2))
        matrix = (inverses[degree] @ turned).transpose(-1, -2)
        bands.append(turn(matrix, coefficients[..., degree**2 : (degree + 1) ** 2]))
        degree += 1
    return torch.cat(bands, -1)


def quaternion(rotations):
    """`[..., 3, 3]` to w x y z. Of the four ways to divide, the one by the largest component."""
    m = rotations
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    ways = torch.stack([
        torch.stack([1 + xx + yy + zz, a, b, c], -1),
        torch.stack([a, 1 + xx - yy - zz, d, e], -1),
        torch.stack([b, d, 1 - xx + yy - zz, f], -1),
        torch.stack([c, e, f, 1 - xx - yy + zz], -1)], -2)
    squares = torch.stack([ways[..., i, i] for i in range(4)], -1)
    best = torch.nn.functional.one_hot(squares.argmax(-1), 4).to(ways.dtype)
    found = (ways * best[..., None]).sum(-2)
    return found / found.norm(dim=-1, keepdim=True)


def times(p, q):
    """Product of quaternions, w x y z."""
    a, b, c, d = p.unbind(-1)
    e, f, g, h = q.unbind(-1)
    return torch.stack([a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g,
                        a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e], -1)


class Graph(torch.nn.Module):
    """An official encoder with the inputs and outputs of `models/README.md`."""

    def __init__(self, encoder):
        super().__init__()
        self.encoder = encoder
        official = encoder.gaussian_adapter.forward

        def recorded(*args, **kwargs):
            self.adapted = official(*args, **kwargs)
            return self.adapted

        encoder.gaussian_adapter.forward = recorded

    def forward(self, images, intrinsics, camera_to_world, near, far):
        views, _, height, width = images.shape
        context = {"image": images[None], "intrinsics": intrinsics[None], "extrinsics": camera_to_world[None],
                   "near": near[None], "far": far[None]}
        self.encoder(context, 0, deterministic=True)
        # [1, V, H W, 1, 1, ...]; intermediate depths, where there are any, come before the last ones.
        one = lambda x, *tail: x[-1:].reshape(views, height, width, *tail)  # noqa: E731
        found = self.adapted
        x, y, z, w = found.rotations[-1:].unbind(-1)
        local = torch.stack([w, x, y, z], -1).reshape(views, height, width, 4)
        camera = quaternion(camera_to_world[:, :3, :3])[:, None, None]
        quats = times(camera, local)
        count = found.harmonics.shape[-1]
        sh = one(found.harmonics, 3, count).transpose(-1, -2)
        return (one(found.means, 3), one(found.scales, 3), quats / quats.norm(dim=-1, keepdim=True),
                one(found.opacities), sh)


class Double(torch.overrides.TorchFunctionMode):
    """Where the official code says f32, f64 is meant."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        wide = lambda x: torch.float64 if x is torch.float32 else x  # noqa: E731
        func = torch.Tensor.double if func is torch.Tensor.float else func
        return func(*map(wide, args), **{name: wide(value) for name, value in (kwargs or {}).items()})


def gaussians(encoder, context, double=False):
    """What the official encoder predicts. With `double` all of it is computed in f64; the encoder stays so."""
    if double:
        encoder, context = encoder.double(), {name: value.double() for name, value in context.items()}
    kept = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64 if double else kept)
    try:
        with Double() if double else contextlib.nullcontext():
            found = encoder(context, 0, deterministic=True)
    finally:
        torch.set_default_dtype(kept)
    return found["gaussians"] if isinstance(found, dict) else found


INPUTS = ["images", "intrinsics", "camera_to_world", "near", "far"]
OUTPUTS = ["means", "scales", "quats", "opacities", "sh"]


def cameras(views, near, far):
    """A set of cameras around a point, as an example and for the comparison."""
    poses = torch.eye(4).repeat(views, 1, 1)
    for v in range(1, views):
        angle = torch.tensor(0.12 * v)
        poses[v, :3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.03 * v, angle], [0.03 * v, 0.0, -0.05], [-angle, 0.05, 0.0]]))
        poses[v, :3, 3] = torch.tensor([-0.4 * v, 0.05 * v, 0.08])
    focal = torch.tensor([[0.9, 0.0, 0.5], [0.0, 0.9, 0.5], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    return focal, poses, torch.full((views,), near), torch.full((views,), far)


def covariance(scales, quats):
    """`[..., 3, 3]` of scales and w x y z quaternions."""
    w, x, y, z = quats.unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
            2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    half = torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3) * scales[..., None, :]
    return half @ half.transpose(-1, -2)
