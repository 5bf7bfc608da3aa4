"""Views of one scene over HTTP: FastAPI, PyTorch on the CPU, PNG by Pillow.

All tiles of a view are blended at once, 16 Gaussians of each tile at a time. As many views are
drawn at once as there are threads, each by one thread."""

import argparse
import io
import threading

import numpy as np
import torch
import uvicorn
from fastapi import FastAPI, Response
from PIL import Image

SH_C0 = 0.28209479177387814
TILE = 16
CHUNK = 16


def read_ply(path):
    """Means, quaternions, scales, opacities, colours of a 3DGS PLY, as float32 tensors."""
    with open(path, "rb") as file:
        names, count = [], 0
        kinds = {"float": "<f4", "ushort": "<u2"}
        while (line := file.readline().decode().strip()) != "end_header":
            words = line.split()
            if words[:2] == ["element", "vertex"]:
                count = int(words[2])
            elif words[0] == "property":
                names.append((words[2], kinds[words[1]]))
        rows = np.frombuffer(file.read(), dtype=np.dtype(names), count=count)
    take = lambda *keys: torch.from_numpy(np.stack([rows[k].astype(np.float32) for k in keys], -1))
    return {
        "means": take("x", "y", "z"),
        "quats": torch.nn.functional.normalize(take("rot_0", "rot_1", "rot_2", "rot_3"), dim=-1),
        "scales": take("scale_0", "scale_1", "scale_2").exp(),
        "opacities": take("opacity")[:, 0].sigmoid(),
        "colours": (take("f_dc_0", "f_dc_1", "f_dc_2") * SH_C0 + 0.5).clamp(min=0),
    }


def rotations(q):
    w, x, y, z = q.unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], -1).view(-1, 3, 3)


@torch.inference_mode()
def render(scene, camera_to_world, fx, fy, cx, cy, width, height, near=0.01):
    view = torch.linalg.inv(camera_to_world)
    rotation, shift = view[:3, :3].float(), view[:3, 3].float()
    at = scene["means"] @ rotation.T + shift
    z = at[:, 2]
    front = z > near
    at, z = at[front], z[front]
    # The Jacobian at the centre, clamped to the frustum widened by 0.3 of its half extent.
    lim_x = (0.5 * width / fx * 1.3, 0.5 * height / fy * 1.3)
    tx = (at[:, 0] / z).clamp(-lim_x[0], lim_x[0]) * z
    ty = (at[:, 1] / z).clamp(-lim_x[1], lim_x[1]) * z
    jacobian = torch.zeros(len(z), 2, 3)
    jacobian[:, 0, 0], jacobian[:, 0, 2] = fx / z, -fx * tx / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = fy / z, -fy * ty / z**2
    axes = rotations(scene["quats"][front]) * scene["scales"][front][:, None, :]
    half = jacobian @ rotation @ axes
    cov = half @ half.transpose(1, 2)
    a, b, c = cov[:, 0, 0] + 0.3, cov[:, 0, 1], cov[:, 1, 1] + 0.3
    det = a * c - b * b
    opacity, colour = scene["opacities"][front], scene["colours"][front]
    u, v = fx * at[:, 0] / z + cx, fy * at[:, 1] / z + cy
    reach = (2 * (255 * opacity).log()).clamp(min=0).sqrt()
    rx, ry = reach * a.sqrt(), reach * c.sqrt()
    seen = (det > 0) & (u + rx > 0) & (u - rx < width) & (v + ry > 0) & (v - ry < height)
    order = torch.argsort(z[seen], stable=True)
    pick = lambda t: t[seen][order]
    u, v, rx, ry, a, b, c, det, opacity, colour = map(
        pick, (u, v, rx, ry, a, b, c, det, opacity, colour))
    conic = torch.stack([c / det, -b / det, a / det], -1)
    # Pairs of tile and Gaussian, in tile order and front to back within each.
    across, down = -(-width // TILE), -(-height // TILE)
    left = ((u - rx) / TILE).floor().clamp(0, across - 1).long()
    right = ((u + rx) / TILE).floor().clamp(0, across - 1).long()
    top = ((v - ry) / TILE).floor().clamp(0, down - 1).long()
    bottom = ((v + ry) / TILE).floor().clamp(0, down - 1).long()
    wide = right - left + 1
    counts = wide * (bottom - top + 1)
    who = torch.repeat_interleave(torch.arange(len(u)), counts)
    nth = torch.arange(len(who)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    tile = (top[who] + nth // wide[who]) * across + left[who] + nth % wide[who]
    tile, place = torch.sort(tile, stable=True)
    who = who[place]
    bounds = torch.searchsorted(tile, torch.arange(across * down + 1))
    ys, xs = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    at = torch.arange(across * down)
    xs = xs.reshape(1, -1) + (at % across * TILE)[:, None]
    ys = ys.reshape(1, -1) + (at // across * TILE)[:, None]
    image = torch.zeros(across * down, TILE * TILE, 3)
    light = torch.ones(across * down, TILE * TILE)
    first = 0
    while True:
        begin = bounds[:-1] + first
        open_tiles = ((begin < bounds[1:]) & (light > 1e-4).any(1)).nonzero()[:, 0]
        if not len(open_tiles):
            break
        nth = begin[open_tiles, None] + torch.arange(CHUNK)
        ids = who[nth.clamp(max=len(who) - 1)]
        dx = xs[open_tiles, :, None] - u[ids][:, None]
        dy = ys[open_tiles, :, None] - v[ids][:, None]
        k = conic[ids][:, None]
        power = (dx * k[..., 0] * -0.5).sub_(dy * k[..., 1]).mul_(dx)
        power.add_(dy.mul_(dy).mul_(k[..., 2] * -0.5))
        strength = torch.where(nth < bounds[1:][open_tiles, None], opacity[ids], 0.0)
        alpha = power.exp_().mul_(strength[:, None]).clamp_(max=0.999)
        alpha.masked_fill_(alpha < 1 / 255, 0.0)
        before = light[open_tiles, :, None]
        after = (1 - alpha).cumprod_(2).mul_(before)
        weight = torch.cat([before, after[..., :-1]], 2).mul_(alpha)
        weight.masked_fill_(after <= 1e-4, 0.0)
        image[open_tiles] += weight @ colour[ids]
        light[open_tiles] = after[..., -1]
        first += CHUNK
    image = image.view(down, across, TILE, TILE, 3).transpose(1, 2)
    return image.reshape(down * TILE, across * TILE, 3)[:height, :width]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("ply")
    parser.add_argument("--port", type=int, default=8090)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(1)
    free = threading.BoundedSemaphore(args.threads)
    scene = read_ply(args.ply)
    app = FastAPI()

    @app.get("/view")
    def view(camera_to_world: str, fx: float, fy: float, cx: float, cy: float,
             width: int, height: int):
        pose = torch.tensor([float(n) for n in camera_to_world.split(",")], dtype=torch.float64)
        file = io.BytesIO()
        with free:
            image = render(scene, pose.view(4, 4), fx, fy, cx, cy, width, height)
            pixels = (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
            Image.fromarray(pixels).save(file, "PNG")
        return Response(file.getvalue(), media_type="image/png")

    @app.get("/healthz")
    def healthz():
        return {"gaussians": len(scene["means"])}

    uvicorn.run(app, host="127.0.0.1", port=args.port, log_level="warning")


if __name__ == "__main__":
    main()
