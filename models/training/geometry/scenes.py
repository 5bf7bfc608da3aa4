"""Random training scenes, made and rendered on the GPU: posed pictures with exact depth.

Frames are OpenCV (+x right, +y down, +z forward); gravity is +y. The focus distance is 1 while a
scene is laid out; `batch` then moves it to the model frame (first camera = identity, largest
baseline of the input views = 1).
"""
import math
import os

import numpy as np
import torch
import torch.nn.functional as F

TEX = 256


# ---- meshes -------------------------------------------------------------------------------------
def _tri_rows(p, uv, rgb, tex, slot):
    """Rows of 20 floats: corner, two edges, uv, colour, texture, slot."""
    n = len(p)
    out = np.zeros((n, 20), np.float32)
    out[:, 0:3], out[:, 3:6], out[:, 6:9] = p[:, 0], p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    out[:, 9:15] = uv.reshape(n, 6)
    out[:, 15:18] = rgb
    out[:, 18], out[:, 19] = tex, slot
    return out


def _grid(points, uv, slot=0):
    """Triangles of a (n+1, m+1) grid of points."""
    n, m = points.shape[0] - 1, points.shape[1] - 1
    a = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:]], 2).reshape(n * m, 3, 3)
    b = np.stack([points[:-1, :-1], points[1:, 1:], points[:-1, 1:]], 2).reshape(n * m, 3, 3)
    ua = np.stack([uv[:-1, :-1], uv[1:, :-1], uv[1:, 1:]], 2).reshape(n * m, 3, 2)
    ub = np.stack([uv[:-1, :-1], uv[1:, 1:], uv[:-1, 1:]], 2).reshape(n * m, 3, 2)
    return _tri_rows(np.concatenate([a, b]), np.concatenate([ua, ub]), 1.0, -1, slot)


def _param(fn, n, m, slot=0):
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
    return _grid(fn(u, v), np.stack([u, v], -1) * [2, 1], slot)


def _box(lo, hi):
    rows = []
    for axis in range(3):
        for side in range(2):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            pts = np.zeros((2, 2, 3))
            for i in range(2):
                for j in range(2):
                    pts[i, j, axis] = hi[axis] if side else lo[axis]
                    pts[i, j, a] = hi[a] if i else lo[a]
                    pts[i, j, b] = hi[b] if j else lo[b]
            uv = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij"), -1)
            rows.append(_grid(pts, uv, axis * 2 + side))
    return np.concatenate(rows)


def _noise(rng, n, octaves, beta):
    """Sum of smooth octaves on an n x n grid, unit range."""
    out = np.zeros((n, n), np.float32)
    for o in range(octaves):
        k = 2 ** (o + 1) + 1
        g = torch.from_numpy(rng.standard_normal((1, 1, k, k)).astype(np.float32))
        out += F.interpolate(g, (n, n), mode="bicubic", align_corners=True)[0, 0].numpy() * beta**o
    return (out - out.min()) / max(out.max() - out.min(), 1e-6)


def _procedural_meshes(rng):
    """(kind, rows) in [-1, 1]: box, round things, heightfields, leaf clutter, frames of rods."""
    t = 2 * math.pi
    yield "box", _box([-1, -1, -1], [1, 1, 1])
    yield "round", _param(lambda u, v: np.stack([np.sin(v * math.pi) * np.cos(u * t), -np.cos(v * math.pi), np.sin(v * math.pi) * np.sin(u * t)], -1), 40, 20)
    yield "round", _param(lambda u, v: np.stack([np.cos(u * t), v * 2 - 1, np.sin(u * t)], -1), 40, 1)
    yield "round", _param(lambda u, v: np.stack([v * np.cos(u * t), v * 2 - 1, v * np.sin(u * t)], -1), 40, 8)
    yield "round", _param(lambda u, v: np.stack([(0.7 + 0.3 * np.cos(v * t)) * np.cos(u * t), 0.3 * np.sin(v * t), (0.7 + 0.3 * np.cos(v * t)) * np.sin(u * t)], -1), 36, 16)
    for _ in range(12):  # vases: surfaces of revolution
        r = 0.25 + 0.75 * _noise(rng, 17, 3, 0.5)[0]
        yield "round", _param(lambda u, v: np.stack([np.interp(v, np.linspace(0, 1, 17), r) * np.cos(u * t), v * 2 - 1, np.interp(v, np.linspace(0, 1, 17), r) * np.sin(u * t)], -1), 32, 24)
    for _ in range(12):  # blobs
        g = _noise(rng, 33, 3, 0.6)
        g[:, -1] = g[:, 0]
        r = 0.55 + 0.45 * g
        yield "round", _param(lambda u, v: np.stack([np.sin(v * math.pi) * np.cos(u * t), -np.cos(v * math.pi), np.sin(v * math.pi) * np.sin(u * t)], -1) * np.pad(r, ((0, 0), (0, 0)))[(u * 32).astype(int), (v * 32).astype(int)][..., None], 32, 32)
    for _ in range(40):
        h = _noise(rng, 41, int(rng.integers(2, 6)), rng.uniform(0.35, 0.75)) * 2 - 1
        u, v = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41), indexing="ij")
        yield "field", _grid(np.stack([u, h, v], -1), np.stack([u, v], -1) * 0.5 + 0.5)
    for _ in range(24):
        n = int(rng.integers(40, 200))
        c = rng.normal(size=(n, 3))
        c = c / np.linalg.norm(c, axis=1, keepdims=True) * rng.uniform(0.2, 0.9, (n, 1))
        a, b = rng.normal(size=(2, n, 3)) * rng.uniform(0.05, 0.25)
        rows = []
        for k in range(n):
            pts = np.array([[c[k] - a[k] - b[k], c[k] - a[k] + b[k]], [c[k] + a[k] - b[k], c[k] + a[k] + b[k]]])
            uv = np.stack(np.meshgrid([0.0, 0.3], [0.0, 0.3], indexing="ij"), -1) + rng.random(2)
            rows.append(_grid(pts, uv, int(rng.integers(0, 6))))
        yield "clutter", np.concatenate(rows)
    for _ in range(24):
        rows, w = [], rng.uniform(0.02, 0.08)
        for _ in range(int(rng.integers(5, 16))):
            lo = rng.uniform(-1, 1 - w, 3)
            hi = lo + w
            axis = int(rng.integers(0, 3))
            lo[axis], hi[axis] = -1 * rng.uniform(0.3, 1), rng.uniform(0.3, 1)
            rows.append(_box(lo, hi))
        if rng.random() < 0.6:
            y = rng.uniform(-0.3, 0.3)
            rows.append(_box([-1, y, -1], [1, y + w, 1]))
        yield "frame", np.concatenate(rows)


def _procedural_textures(rng, n):
    for i in range(n):
        a, b = rng.uniform(0, 255, (2, 3))
        if i % 4 == 0:  # noise between two colours
            k = _noise(rng, TEX, int(rng.integers(3, 8)), rng.uniform(0.4, 0.9))
        elif i % 4 == 1:  # wood: stretched noise
            g = torch.from_numpy(rng.standard_normal((1, 1, int(rng.integers(3, 6)), int(rng.integers(40, 120)))).astype(np.float32))
            k = F.interpolate(g, (TEX, TEX), mode="bicubic")[0, 0].numpy()
            k = (k - k.min()) / (k.max() - k.min())
        elif i % 4 == 2:  # stripes and checks with wobble
            u, v = np.meshgrid(np.arange(TEX) / TEX, np.arange(TEX) / TEX, indexing="ij")
            f = rng.integers(2, 20, 2)
            s = np.sin(2 * math.pi * (u * f[0] + 0.1 * _noise(rng, TEX, 4, 0.6)))
            k = (s * (np.sin(2 * math.pi * v * f[1]) if rng.random() < 0.5 else 1) > rng.uniform(-0.5, 0.5)) * 0.8 + 0.2 * _noise(rng, TEX, 6, 0.8)
        else:  # nearly plain, fine grain
            b = a + rng.normal(0, 20, 3)
            k = 0.5 * _noise(rng, TEX, 3, 0.5) + 0.5 * rng.random((TEX, TEX))
        yield (a + (b - a) * np.asarray(k)[..., None]).clip(0, 255).astype(np.uint8)


# ---- the bank -----------------------------------------------------------------------------------
class World:
    """Meshes and textures on the GPU, and the sampler of scenes over them."""

    SLOTS = 30

    def __init__(self, ext, pack, device, seed):
        import io

        from PIL import Image

        self.ext, self.device = ext, device
        rng = np.random.default_rng(11)
        z = np.load(os.path.join(pack, "textures.npz"))
        blob, off, assets = z["blob"].tobytes(), z["offsets"], int(z["assets"])
        images = [np.asarray(Image.open(io.BytesIO(blob[off[i] : off[i + 1]])).convert("RGB")) for i in range(len(off) - 1)]
        images += list(_procedural_textures(rng, 240))
        tex = torch.from_numpy(np.stack(images)).to(device).permute(0, 3, 1, 2).float()
        mips = []
        for _ in range(8):
            mips.append(tex.round().clamp(0, 255).byte().permute(0, 2, 3, 1).reshape(len(images), -1))
            tex = F.avg_pool2d(tex, 2)
        self.bank = torch.cat(mips, 1).contiguous()
        self.assets, self.textures = assets, len(images)

        m = np.load(os.path.join(pack, "meshes.npz"))
        p, uv = m["p"].astype(np.float32), m["uv"].astype(np.float32)
        asset_rows = _tri_rows(p, uv, m["rgb"] / 255.0, m["tex"], 0)
        rows, kinds, start = [], [], 0
        for kind, r in _procedural_meshes(rng):
            rows.append(r)
            kinds.append(kind)
        for c in m["counts"]:
            rows.append(asset_rows[start : start + c])
            kinds.append("asset")
            start += c
        ranges = torch.tensor(np.cumsum([0] + [len(r) for r in rows]), dtype=torch.int64)
        corner = [np.concatenate([r[:, 0:3], r[:, 0:3] + r[:, 3:6], r[:, 0:3] + r[:, 6:9]]) for r in rows]
        self.lo = torch.tensor(np.stack([c.min(0) for c in corner]), device=device)
        self.hi = torch.tensor(np.stack([c.max(0) for c in corner]), device=device)
        nodes, tris, roots = ext.build_bvh(torch.from_numpy(np.concatenate(rows)), ranges)
        self.nodes, self.tris, self.roots = nodes.to(device), ext.pack(tris.to(device)), roots.to(device)
        self.kinds = {k: torch.tensor([i for i, x in enumerate(kinds) if x == k], device=device) for k in set(kinds)}
        self.first_asset = self.kinds["asset"][0]
        self.gen = torch.Generator(device=device).manual_seed(seed)

    # -- random helpers
    def u(self, *shape, lo=0.0, hi=1.0):
        return torch.rand(*shape, device=self.device, generator=self.gen) * (hi - lo) + lo

    def logu(self, *shape, lo, hi):
        return torch.exp(self.u(*shape, lo=math.log(lo), hi=math.log(hi)))

    def n(self, *shape):
        return torch.randn(*shape, device=self.device, generator=self.gen)

    def pick(self, kind, *shape):
        ids = self.kinds[kind]
        return ids[torch.randint(len(ids), shape, device=self.device, generator=self.gen)]

    def coin(self, *shape, p=0.5):
        return self.u(*shape) < p

    def rotations(self, *shape):
        q = F.normalize(self.n(*shape, 4), dim=-1)
        return quat_to_rot(q)

    # -- one batch
    def batch(self, B, V, T, size, target_size, wide=1.0):
        """B scenes, V input and T target views of (height, width); model frame.

        Returns images [B,V,3,*size], targets [B,T,3,*target_size], depth [B,V,*size], K [B,V+T,3,3]
        normalised, c2w [B,V+T,4,4], near/far [B,V].
        """
        H, W = size
        mode = self.u(B)
        room, table, relief = mode < 0.38, (mode >= 0.38) & (mode < 0.72), (mode >= 0.72) & (mode < 0.84)
        pitch = torch.where(table, self.u(B, lo=12, hi=65), torch.where(room, self.u(B, lo=-12, hi=28), self.u(B, lo=-12, hi=12)))
        pitch = torch.deg2rad(pitch)
        focus = torch.stack([torch.zeros_like(pitch), torch.sin(pitch), torch.cos(pitch)], -1)
        lo_b = 0.07 - 0.05 * wide
        b = self.logu(B, lo=lo_b, hi=0.28 + 0.3 * wide)
        cams, K = self.rig(B, V, T, H, W, b, focus, wide)
        inst, lights = self.layout(B, room, table, relief, focus, b, cams)
        images, depth = self.draw(inst, lights, cams[:, :V], K[:, :V], H, W)
        targets, _ = self.draw(inst, lights, cams[:, V:], K[:, V:], *target_size)
        # Model frame.
        scale = torch.cdist(cams[:, :V, :3, 3], cams[:, :V, :3, 3]).flatten(1).amax(1)
        c2w = torch.linalg.inv(cams[:, :1]) @ cams
        c2w[..., :3, 3] /= scale[:, None, None]
        depth = (depth / scale[:, None, None, None]).clamp(max=1e5)
        near, far = self.near_far(depth)
        images, targets = self.photo(images, targets)
        return images, targets, depth, K, c2w, near, far

    def draw(self, inst, lights, cams, K, H, W):
        lens = torch.stack([K[..., 0, 0] * W, K[..., 1, 1] * H, K[..., 0, 2] * W, K[..., 1, 2] * H], -1)
        cam16 = torch.cat([cams[:, :, :3].reshape(*cams.shape[:2], 12), lens], -1).contiguous()
        return self.ext.render(lights, inst, self.nodes, self.tris, self.bank, TEX, 8, cam16, H, W)[:2]

    def near_far(self, depth):
        B, V = depth.shape[:2]
        inv = (1.0 / depth.clamp(min=1e-3))[..., ::4, ::4].flatten(2)
        q = torch.quantile(inv, torch.tensor([0.01, 0.99], device=self.device), dim=-1)
        span = (q[1] - q[0]).clamp(min=1e-4)
        # Mostly a close range; at times a loose one, as a false match at run time gives.
        grow = lambda: torch.where(self.coin(B, V, p=0.72), self.u(B, V, lo=-0.01, hi=0.15), torch.where(self.coin(B, V, p=0.7), self.u(B, V, lo=0.1, hi=0.8), self.u(B, V, lo=0.5, hi=4.0)))
        lo = (q[0] - span * grow()).clamp(min=1e-4)
        hi = q[1] + span * grow() + 0.002
        # One range for the whole set as often as one for each view.
        same = self.coin(B, 1, p=0.3)
        lo = torch.where(same, lo.amin(1, keepdim=True), lo)
        hi = torch.where(same, hi.amax(1, keepdim=True), hi)
        return 1.0 / hi, 1.0 / lo

    def photo(self, images, targets):
        """What cameras do: slight blur, exposure and white balance for each view, noise."""
        B, V = images.shape[:2]
        s = self.u(B, lo=0.0, hi=0.28) * self.coin(B, p=0.7)
        k1 = torch.stack([s, 1 - 2 * s, s], -1)
        k = (k1[:, :, None] * k1[:, None, :])[:, None]
        on = self.coin(B, 1, 1, p=0.7).float()
        gain = torch.exp((self.n(B, V, 1) * 0.035 + self.n(B, V, 3) * 0.01) * on)
        images = blurred(images, k) * gain[..., None, None]
        targets = blurred(targets, k) * gain.mean(1, keepdim=True)[..., None, None]
        noise = torch.randn(images.shape, device=self.device, generator=self.gen) * self.u(B, 1, 1, 1, 1, hi=0.012)
        return (images + noise).clamp(0, 1), targets.clamp(0, 1)

    def rig(self, B, V, T, H, W, b, focus, wide):
        N = V + T
        # Input pair at the ends of a mostly sideways baseline; others around; targets near the middle.
        a = self.u(B, hi=2 * math.pi)
        side = torch.stack([torch.cos(a), torch.sin(a) * 0.6, self.n(B) * 0.3], -1)
        side = F.normalize(side, dim=-1) * b[:, None]
        ball = lambda *s: F.normalize(self.n(*s, 3), dim=-1) * self.u(*s, 1) ** (1 / 3)
        squash = torch.tensor([1.0, 0.7, 0.6], device=self.device)
        pos = torch.zeros(B, N, 3, device=self.device)
        pos[:, 0], pos[:, 1] = -side / 2, side / 2
        if V > 2:
            # More than four photos lie along a longer walk.
            far = self.logu(B, 1, 1, lo=1.1, hi=1.1 if V <= 4 else 2.5)
            pos[:, 2:V] = ball(B, V - 2) * squash * b[:, None, None] * far
        # Most targets lie between the inputs, some well outside: nothing may smear there either.
        reach = torch.where(self.coin(B, T, 1, p=0.85), 0.45, 1.0)
        pos[:, V:] = ball(B, T) * squash * reach * b[:, None, None] + side[:, None] * self.u(B, T, 1, lo=-0.2, hi=0.2)
        up = torch.tensor([0.0, -1.0, 0.0], device=self.device)
        fwd0 = focus
        right0 = F.normalize(torch.cross(fwd0, up.expand_as(fwd0), dim=-1), dim=-1)
        down0 = torch.cross(fwd0, right0, dim=-1)
        basis = torch.stack([right0, down0, fwd0], -1)  # columns
        world = pos @ basis.transpose(1, 2)
        conv = self.u(B, 1, 1) * self.coin(B, 1, 1, p=0.8)
        aim = focus[:, None] + self.n(B, N, 3) * 0.06 * self.u(B, 1, 1)
        fwd = F.normalize(aim - world * conv, dim=-1)
        right = F.normalize(torch.cross(fwd, up.expand_as(fwd), dim=-1), dim=-1)
        down = torch.cross(fwd, right, dim=-1)
        roll = self.n(B, 1) * 0.1 + (math.pi / 2) * self.coin(B, 1, p=0.12) + self.n(B, N) * 0.03
        c, s = torch.cos(roll)[..., None], torch.sin(roll)[..., None]
        R = torch.stack([right * c + down * s, down * c - right * s, fwd], -1)
        cams = torch.eye(4, device=self.device).repeat(B, N, 1, 1)
        cams[:, :, :3, :3], cams[:, :, :3, 3] = R, world
        fov = torch.deg2rad(torch.where(self.coin(B, p=0.7), self.u(B, lo=38, hi=68), self.u(B, lo=30 + 5 * (1 - wide), hi=70 + 30 * wide)))
        f = 0.5 * max(H, W) / torch.tan(fov / 2)
        f = f[:, None] * torch.exp(self.n(B, N) * 0.02 * self.coin(B, 1, p=0.3))
        off = self.n(B, 1, 2) * torch.where(self.coin(B, 1, 1, p=0.15), 0.08, 0.01)
        K = torch.zeros(B, N, 3, 3, device=self.device)
        K[..., 0, 0], K[..., 1, 1], K[..., 2, 2] = f / W, f * torch.exp(self.n(B, 1) * 0.01) / H, 1
        K[..., 0, 2], K[..., 1, 2] = 0.5 + off[..., 0], 0.5 + off[..., 1]
        return cams, K

    def layout(self, B, room, table, relief, focus, b, cams):
        S, dev = self.SLOTS, self.device
        A = torch.zeros(B, S, 3, 3, device=dev)  # local -> world linear part
        t = torch.zeros(B, S, 3, device=dev)
        mesh = torch.zeros(B, S, dtype=torch.long, device=dev)
        on = torch.ones(B, S, dtype=torch.bool, device=dev)
        upright = torch.diag(torch.tensor([1.0, -1.0, -1.0], device=dev))

        # Slot 0: the room, a box around everything, turned about gravity.
        outdoor = ~(room | table | relief)
        back = torch.where(room, self.logu(B, lo=1.15, hi=5), torch.where(table, self.logu(B, lo=1.4, hi=25), torch.where(relief, self.u(B, lo=1.05, hi=1.5), self.logu(B, lo=3, hi=150))))
        sides = [torch.where(outdoor, self.logu(B, lo=2, hi=100), self.logu(B, lo=0.75, hi=5)) for _ in range(2)]
        floor = torch.where(table, focus[:, 1] + self.u(B, hi=0.06), self.u(B, lo=0.35, hi=1.2) + b * 0.5)
        ceil = torch.where(outdoor, self.logu(B, lo=3, hi=100), self.u(B, lo=0.7, hi=2.5))
        behind = self.u(B, lo=0.8, hi=2)
        # A finite table inside a room: the floor drops, the table top stays.
        top = floor.clone()
        finite = table & self.coin(B, p=0.6)
        floor = torch.where(finite, floor + self.u(B, lo=0.3, hi=1.2), floor)
        half = torch.stack([(sides[0] + sides[1]) / 2, (floor + ceil) / 2, (back + behind) / 2], -1)
        mid = torch.stack([(sides[0] - sides[1]) / 2, (floor - ceil) / 2, (back - behind) / 2], -1)
        yaw = self.rot_y(self.n(B) * 0.35 * (~relief))
        A[:, 0], t[:, 0] = yaw * half[:, None, :], (yaw @ mid[..., None])[..., 0]
        mesh[:, 0] = self.kinds["box"][0]

        # Slot 1: the table's slab. Slots 2..4: relief (heightfields) on the back wall or the floor.
        size = torch.stack([self.u(B, lo=0.35, hi=1.6), torch.full((B,), 0.02, device=dev), self.u(B, lo=0.35, hi=1.6)], -1)
        A[:, 1] = self.rot_y(self.u(B, hi=6.28)) * size[:, None, :]
        t[:, 1] = focus + self.n(B, 3) * 0.1
        t[:, 1, 1] = top + 0.02
        mesh[:, 1] = self.kinds["box"][0]
        on[:, 1] = finite
        for k in range(2, 4):
            mesh[:, k] = self.pick("field", B)
            amp = self.logu(B, lo=0.02, hi=0.25)
            wall = relief | self.coin(B, p=0.5)
            ext = self.logu(B, lo=0.2, hi=1.5)
            face = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]], device=dev)  # grid's y -> world z
            R = torch.where(wall[:, None, None], yaw @ face, yaw)
            A[:, k] = R * torch.stack([ext, amp, ext], -1)[:, None, :]
            place = torch.stack([self.n(B) * 0.4, self.n(B) * 0.3, back * self.u(B, lo=0.75, hi=0.98)], -1)
            lay = torch.stack([self.n(B) * 0.5, top - amp * 0.5, focus[:, 2] + self.n(B) * 0.3], -1)
            t[:, k] = torch.where(wall[:, None], place, lay)
            on[:, k] = self.coin(B, p=0.35) | (relief & (k == 2))

        # The rest: objects. Some rest upright on the floor or table, some float, most near the focus.
        n0, m = 4, S - 4
        kind = self.u(B, m)
        mesh[:, n0:] = torch.where(kind < 0.45, self.pick("asset", B, m), torch.where(kind < 0.62, self.pick("box", B, m), torch.where(kind < 0.8, self.pick("round", B, m), torch.where(kind < 0.88, self.pick("frame", B, m), torch.where(kind < 0.95, self.pick("clutter", B, m), self.pick("field", B, m))))))
        rest = self.coin(B, m, p=0.65)
        z = torch.where(self.coin(B, m, p=0.6), 1 + self.n(B, m) * 0.22, torch.exp(self.u(B, m) * torch.log(back * 0.95 / 0.45)[:, None]) * 0.45).clamp(min=0.4)
        ray = torch.stack([self.n(B, m) * 0.33, self.n(B, m) * 0.28, torch.ones(B, m, device=dev)], -1)
        basis = cams[:, 0, :3, :3]
        p = (ray * z[..., None]) @ basis.transpose(1, 2)
        size = self.logu(B, m, lo=0.04, hi=0.32) * z
        shape = torch.where(self.coin(B, m, 1, p=0.5), torch.ones(B, m, 3, device=dev), torch.exp(self.n(B, m, 3) * 0.5))
        thin = self.coin(B, m, p=0.12)
        shape = torch.where(thin[..., None], shape * torch.tensor([1.0, 0.06, 1.0], device=dev), shape)
        scales = size[..., None] * shape
        R = torch.where(rest[..., None, None], self.rot_y(self.u(B * m, hi=6.28)).reshape(B, m, 3, 3) @ upright, self.rotations(B, m))
        # Upright things stand: the mesh's lowest point (its -y bound, flipped) touches the top.
        low = self.lo[mesh[:, n0:]][..., 1] * scales[..., 1]
        p[..., 1] = torch.where(rest, top[:, None] + low, p[..., 1])
        A[:, n0:], t[:, n0:] = R * scales[..., None, :], p
        count = self.u(B, 1, lo=3, hi=m + 1)
        # Nothing may stand in a camera: bounding sphere against every camera of the rig.
        radius = scales.norm(dim=-1)
        gap = (p[:, :, None] - cams[:, None, :, :3, 3]).norm(dim=-1).amin(-1)
        on[:, n0:] = (torch.arange(m, device=dev) < count) & (gap > radius + 0.18)

        inv = torch.linalg.inv(A + torch.eye(3, device=dev) * 1e-12)
        inv34 = torch.cat([inv, -(inv @ t[..., None])], -1)
        root = torch.where(on, self.roots[mesh].long(), -1).float()

        # Looks. Photographs on most faces, plain or procedural on the rest, assets mostly as made.
        photo = torch.randint(self.assets, self.textures, (B, S, 6), device=dev, generator=self.gen)
        proc = torch.randint(self.textures - 240, self.textures, (B, S, 6), device=dev, generator=self.gen)
        tex = torch.where(self.coin(B, S, 6, p=0.3), proc, photo)
        one = self.coin(B, S, 1, p=0.35)
        tex = torch.where(one, tex[..., :1].expand_as(tex), tex)
        is_asset = mesh >= self.first_asset
        own = is_asset & self.coin(B, S, p=0.75)
        tex = torch.where(own[..., None], -2, tex)
        show = torch.where(self.coin(B, S, p=0.62), torch.ones(B, S, device=dev), self.u(B, S, hi=0.6) ** 2)
        show = torch.where(own, 1.0, show)
        tint = self.u(B, S, 1, lo=0.25, hi=1.0) + self.n(B, S, 3) * 0.12
        tint = torch.where(own[..., None], 1 + self.n(B, S, 3) * 0.05, tint).clamp(0.03, 1.1)
        repeat = self.logu(B, S, lo=0.5, hi=2.5)
        repeat[:, 0] = self.logu(B, lo=0.8, hi=5)
        spec = self.u(B, S, hi=0.5) * self.coin(B, S, p=0.12)
        inst = torch.cat([inv34.reshape(B, S, 12), root[..., None], tex.float(), tint, show[..., None], repeat[..., None], spec[..., None], torch.zeros(B, S, 1, device=dev)], -1)
        l1 = torch.stack([self.n(B) * 1.5, -self.u(B, lo=0.3, hi=3), self.n(B) * 1.5 + 0.3], -1)
        l2 = torch.stack([self.n(B) * 3, self.n(B) * 2, self.n(B) * 3], -1)
        amb = self.u(B, 1, lo=0.3, hi=0.6)
        c1 = self.u(B, 1, lo=0.15, hi=0.6) * (1 + self.n(B, 3) * 0.06)
        c2 = self.u(B, 1, lo=0.0, hi=0.25) * (1 + self.n(B, 3) * 0.06)
        return inst.contiguous(), torch.cat([l1, l2, c1, c2, amb], -1).contiguous()

    def rot_y(self, a):
        c, s, o, z = torch.cos(a), torch.sin(a), torch.ones_like(a), torch.zeros_like(a)
        return torch.stack([c, z, s, z, o, z, -s, z, c], -1).reshape(*a.shape, 3, 3)


def blurred(rgb, k):
    """Pictures [B,N,3,H,W] under one 3x3 kernel [B,1,3,3] for each scene."""
    h, w = rgb.shape[-2:]
    pad = F.pad(rgb.flatten(1, 2), (1, 1, 1, 1), mode="replicate")
    return sum(pad[..., i : i + h, j : j + w] * k[:, :, i, j, None, None] for i in range(3) for j in range(3)).reshape_as(rgb)


def quat_to_rot(q):
    w, x, y, z = q.unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], -1).reshape(*q.shape[:-1], 3, 3)
