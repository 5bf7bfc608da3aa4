"""Pictures of random scenes with exact instances, and real photographs with drawn regions, on the GPU.

A picture of either kind is `rgb` [B,3,S,S] 0..1 with `whole` and `part` [B,S,S]: one number for each
thing and for each part of one, -1 where nothing is known.
"""
import io
import json
import os
import sys
import tarfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import torch.distributed as dist
import torch.nn.functional as F
from PIL import Image
from torch.utils.cpp_extension import load

HERE = os.path.dirname(os.path.abspath(__file__))
GEOMETRY = os.path.join(HERE, "..", "geometry")
sys.path.insert(0, GEOMETRY)
from scenes import World  # noqa: E402

from cuts import SETS as SEGMENTS  # noqa: E402
from heldout import heldout  # noqa: E402


def extension():
    return load("raycast", [os.path.join(GEOMETRY, "raycast.cu")], extra_cflags=["-O3"], extra_cuda_cflags=["-O3", "--use_fast_math"])


# What computes: a GPU, or, to try a script out, the processor.
KIND = "cuda" if torch.cuda.is_available() else "cpu"


def join():
    """Rank, number of processes and device of this process of a torchrun."""
    dist.init_process_group("nccl" if KIND == "cuda" else "gloo")
    device = torch.device("cpu")
    if KIND == "cuda":
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    return dist.get_rank(), dist.get_world_size(), device


class Rooms(World):
    """The geometry network's scenes, with meshes of the evaluation left out."""

    def __init__(self, ext, pack, device, seed):
        super().__init__(ext, pack, device, seed)
        with open(os.path.join(HERE, "heldout_meshes.txt")) as file:
            out = {row.strip() for row in file if row.strip()}
        names = np.load(os.path.join(pack, "meshes.npz"))["names"]
        first = int(self.first_asset)
        self.names = {first + i: str(n) for i, n in enumerate(names)}
        self.kinds["asset"] = torch.tensor([m for m, n in self.names.items() if n not in out], device=device)

    @torch.no_grad()
    def views(self, B, S):
        """`rgb`, `whole`, `part`, and the mesh of each whole: [B, SLOTS] (-1 where none)."""
        mode = self.u(B)
        room, table, relief = mode < 0.4, (mode >= 0.4) & (mode < 0.8), (mode >= 0.8) & (mode < 0.88)
        pitch = torch.deg2rad(torch.where(table, self.u(B, lo=12, hi=65), torch.where(room, self.u(B, lo=-12, hi=28), self.u(B, lo=-12, hi=12))))
        focus = torch.stack([torch.zeros_like(pitch), torch.sin(pitch), torch.cos(pitch)], -1)
        b = self.logu(B, lo=0.05, hi=0.4)
        cams, K = self.rig(B, 2, 0, S, S, b, focus, 1.0)
        inst, lights = self.layout(B, room, table, relief, focus, b, cams)
        cam = torch.cat([cams[:, :1, :3].reshape(B, 1, 12), torch.stack([K[:, :1, 0, 0] * S, K[:, :1, 1, 1] * S, K[:, :1, 0, 2] * S, K[:, :1, 1, 2] * S], -1)], -1)
        rgb, _, ids = self.ext.render(lights, inst, self.nodes, self.tris, self.bank, 256, 8, cam.contiguous(), S, S)
        ids = ids[:, 0]
        slot, part = ids & 255, ids >> 8
        # Walls, floor and ceiling are things of their own: the room is cut by its faces.
        whole = torch.where(slot == 0, 64 + part % 97, slot)
        whole = torch.where(ids < 0, -1, whole)
        root = inst[:, :, 12].contiguous()
        mesh = torch.searchsorted(self.roots.float().contiguous(), root).long()
        mesh = torch.where(root < 0, -1, mesh)
        # Rooms rarely look like photographs; a photograph behind the things at times does.
        rgb = rgb[:, 0]
        swap = (self.u(B) < 0.3)[:, None, None] & (whole >= 64)
        back = self.photographs(B, S)
        rgb = torch.where(swap[:, None], back, rgb)
        whole = torch.where(swap, -1, whole)
        rgb = self.camera(rgb)
        return rgb, whole, torch.where(whole < 0, -1, ids), mesh

    def photographs(self, B, S):
        pick = torch.randint(self.assets, self.textures - 240, (B,), device=self.device, generator=self.gen)
        x = self.bank[pick, : 256 * 256 * 3].reshape(B, 256, 256, 3).permute(0, 3, 1, 2).float() / 255
        return F.interpolate(x, (S, S), mode="bilinear")

    def camera(self, rgb):
        """Blur, exposure, white balance, contrast, noise."""
        B = len(rgb)
        s = (self.u(B, hi=0.25) * self.coin(B, p=0.6)).view(B, 1, 1, 1)
        rgb = rgb * (1 - s) + F.avg_pool2d(F.pad(rgb, (1, 1, 1, 1), mode="replicate"), 3, 1) * s
        gain = torch.exp(self.n(B, 1) * 0.15 + self.n(B, 3) * 0.05)
        rgb = rgb * gain[..., None, None]
        c = torch.exp(self.n(B, 1, 1, 1) * 0.12)
        rgb = (rgb - 0.45) * c + 0.45
        return (rgb + torch.randn(rgb.shape, device=rgb.device, generator=self.gen) * self.u(B, 1, 1, 1, hi=0.02)).clamp(0, 1)


def _fit(img, size, how):
    """Longest side to `size`; [h, w] array."""
    w, h = img.size
    k = size / max(w, h)
    return np.asarray(img.resize((max(1, round(w * k)), max(1, round(h * k))), how))


def _regions(label):
    """Connected regions of equal label, as numbers from 0."""
    from scipy.ndimage import label as components

    out, n = np.full(label.shape, -1, np.int32), 0
    for v in np.unique(label):
        c, k = components(label == v)
        out = np.where(c > 0, c + n - 1, out)
        n += k
    return out


# Photographs with segments, some of them with "not labelled" as 0, and three sets of other forms.
SETS = SEGMENTS + ("bsds500", "camvid", "human_seg")
# How often a set is drawn, for each of its photographs; and those whose things are pasted elsewhere.
WEIGHT = {"coco_panoptic_200": 3.0, "coco_instances": 3.0, "furniture_seg": 0.7, "household_polygons": 0.7, "pets_trimaps": 0.5, "ade20k_samples": 3.0,
          "bsds500": 1.0, "camvid": 0.5, "human_seg": 1.0}
THINGS = ("coco_panoptic_200", "coco_instances", "household_polygons", "pets_trimaps", "human_seg")


def regions(data, part, sets=SETS):
    """(set, rgb, whole, part, names) of the photographs with drawn regions; `part`: "train" or "heldout"."""
    want = part == "heldout"
    for name in sets:
        yield from _of_set(data, name, want)


def _of_set(data, name, want):
    """One set's photographs whose `heldout` is `want`."""
    t = tarfile.open(os.path.join(data, name + ".tar"))
    files = sorted(n for n in t.getnames() if n.startswith("images/") and n.endswith(".jpg"))
    files = [f for i, f in enumerate(files) if heldout(i) == want]
    segments = json.load(t.extractfile("segments.json")) if name in SEGMENTS else None
    # Read in order, decoded side by side.
    folders = ["masks"] if name in SEGMENTS or name == "human_seg" else ["segs"] if name == "bsds500" else ["labels"]
    ends = ["_0", "_2"] if name == "bsds500" else [""]
    blobs = []
    for f in files:
        stem = os.path.basename(f)[:-4]
        blobs.append((stem, t.extractfile(f).read(), [t.extractfile(f"{folders[0]}/{stem}{e}.png").read() for e in ends]))
    with ThreadPoolExecutor(min(16, os.cpu_count() or 1)) as pool:
        yield from pool.map(lambda b: (name, *_decoded(name, segments, *b)), blobs)


def _decoded(name, segments, stem, image, masks):
    """rgb, whole, part and names of one photograph of a set."""
    rgb = _fit(Image.open(io.BytesIO(image)).convert("RGB"), 512, Image.BILINEAR)
    read = lambda i: _fit(Image.open(io.BytesIO(masks[i])), 512, Image.NEAREST).astype(np.int32)
    if name in SEGMENTS:
        m = read(0)
        info = {s["index"]: s for s in segments[stem]["segments"]}
        whole = np.where(np.isin(m, [k for k, s in info.items() if not s.get("iscrowd")]), m, -1)
        return rgb, whole, None, {k: s["name"] for k, s in info.items()}
    if name == "bsds500":
        return rgb, read(0), read(1), {}
    if name == "camvid":
        m = read(0)
        return rgb, np.where(m == 11, -1, _regions(m)), None, {"class_of": m}
    m = _fit(Image.open(io.BytesIO(masks[0])).convert("L"), 512, Image.NEAREST)
    return rgb, np.where(m > 127, 1, -1), None, {1: "person"}


class Photographs:
    """Photographs with regions, held on the GPU; `batch` crops, scales, flips and recolours them."""

    def __init__(self, data, part, device, seed, size=512):
        rgb, whole, fine, kind = [], [], [], []
        for source, img, w, p, _ in regions(data, part):
            pad = lambda a, v: np.pad(a, [(0, size - a.shape[0]), (0, size - a.shape[1])] + [(0, 0)] * (a.ndim - 2), constant_values=v)
            rgb.append(torch.from_numpy(pad(img, 127)))
            whole.append(torch.from_numpy(pad(w, -1).astype(np.int16)))
            fine.append(torch.from_numpy(pad(w if p is None else p, -1).astype(np.int16)))
            kind.append((source, img.shape[:2], p is not None))
        self.rgb = torch.stack(rgb).to(device).permute(0, 3, 1, 2).contiguous()
        self.whole, self.fine = torch.stack(whole).to(device), torch.stack(fine).to(device)
        self.kind, self.size, self.device = kind, size, device
        self.shape = torch.tensor([k[1] for k in kind], device=device).float()
        self.weight = torch.tensor([WEIGHT[k[0]] for k in kind], device=device)
        self.things = torch.tensor([WEIGHT[k[0]] * (k[0] in THINGS) for k in kind], device=device)
        self.gen = torch.Generator(device=device).manual_seed(seed)

    def __len__(self):
        return len(self.kind)

    @torch.no_grad()
    def batch(self, B, things=False):
        """`B` pictures; with `things` of the sets whose things are outlined one by one."""
        S, dev, g = self.size, self.device, self.gen
        u = lambda *s: torch.rand(*s, device=dev, generator=g)
        pick = torch.multinomial(self.things if things else self.weight, B, True, generator=g)
        hw = self.shape[pick]
        # Window: mostly the whole photo, at times a closer or a farther one; square or not.
        k = torch.where(u(B) < 0.4, torch.ones(B, device=dev), torch.exp(u(B) * 1.3 - 1.1))
        side = torch.stack([k * hw.amax(1), k * hw.amax(1) * torch.exp((u(B) - 0.5) * 0.3)], -1)
        room = (hw.flip(-1) - side)
        at = torch.where(k[:, None] < 0.98, room * u(B, 2), torch.zeros(B, 2, device=dev))
        grid = (torch.arange(S, device=dev) + 0.5) / S
        x = at[:, 0, None] + grid * side[:, :1]
        y = at[:, 1, None] + grid * side[:, 1:]
        flip = u(B) < 0.5
        x = torch.where(flip[:, None], x.flip(1), x)
        inside = ((x >= 0) & (x < hw[:, 1:]))[:, None] & ((y >= 0) & (y < hw[:, :1]))[..., None]
        xy = torch.stack([x[:, None].expand(B, S, S), y[..., None].expand(B, S, S)], -1) / S * 2 - 1
        rgb = F.grid_sample(self.rgb[pick].float() / 255, xy, mode="bilinear", padding_mode="border", align_corners=False)
        xi, yi = x.long().clamp(0, S - 1), y.long().clamp(0, S - 1)
        take = lambda a: torch.where(inside, a[pick[:, None, None], yi[..., None], xi[:, None]].int(), -1)
        whole, fine = take(self.whole), take(self.fine)
        gain = torch.exp((u(B, 3, 1, 1) - 0.5) * 0.2 + (u(B, 1, 1, 1) - 0.5) * 0.5)
        c = torch.exp((u(B, 1, 1, 1) - 0.5) * 0.4)
        gray = rgb.mean(1, keepdim=True)
        sat = torch.where(u(B, 1, 1, 1) < 0.1, torch.zeros(B, 1, 1, 1, device=dev), 0.6 + u(B, 1, 1, 1) * 0.8)
        rgb = (((gray + (rgb - gray) * sat) * gain - 0.45) * c + 0.45).clamp(0, 1)
        rgb = torch.where(inside[:, None], rgb, 127 / 255)
        return rgb, whole, fine

    @torch.no_grad()
    def paste(self, rgb, whole, part, donor, number=0):
        """Things of another batch, moved and scaled, over this one: new outlines for free. `number` tells
        one paste of a picture from the next."""
        drgb, dwhole, _ = donor
        B, S = len(rgb), rgb.shape[-1]
        g = self.gen
        u = lambda *s: torch.rand(*s, device=self.device, generator=g)
        px = torch.multinomial((dwhole.flatten(1) >= 0).float() + 1e-6, 1, generator=g)[:, 0]
        label = dwhole.flatten(1).gather(1, px[:, None])[..., None]
        mask = (dwhole == label) & (label >= 0)
        share = mask.float().mean((1, 2))
        ok = (share > 0.004) & (share < 0.5) & (u(B) < 0.6)
        k = torch.exp((u(B) - 0.5) * 0.9)
        theta = torch.zeros(B, 2, 3, device=self.device)
        theta[:, 0, 0], theta[:, 1, 1] = k * torch.where(u(B) < 0.5, 1, -1), k
        theta[:, :, 2] = (u(B, 2) - 0.5) * 1.2
        grid = F.affine_grid(theta, (B, 1, S, S), align_corners=False)
        m = F.grid_sample(mask[:, None].float(), grid, align_corners=False) * ok[:, None, None, None]
        m = (m > 0.5).float() * F.avg_pool2d(m, 3, 1, 1)
        c = F.grid_sample(drgb, grid, align_corners=False)
        on = m[:, 0] > 0.5
        return rgb * (1 - m) + c * m, torch.where(on, 9000 + number, whole), torch.where(on, 900000 + number, part)
