"""The embedded geometry network: posed photos in, one Gaussian per pixel out.

Frames are OpenCV. All lengths are in model units (first camera = identity, largest baseline = 1),
but nothing depends on the unit: depth is searched between the `near` and `far` given per view, and
sizes are relative to the depth. Stages: encoder with neighbour attention (1/8) -> plane sweep at
1/4 over 64 inverse depths -> U-Net -> local sweep at 1/2 -> full-resolution head that sees each
neighbour's colours warped by the depth and how well its depth agrees.
"""
import torch
import torch.nn as nn
import torch.nn.functional as F

SH_C0 = 0.28209479177387814


class Res(nn.Module):
    def __init__(self, c, groups=8):
        super().__init__()
        self.n1, self.n2 = nn.GroupNorm(groups, c), nn.GroupNorm(groups, c)
        self.c1, self.c2 = nn.Conv2d(c, c, 3, padding=1), nn.Conv2d(c, c, 3, padding=1)
        nn.init.zeros_(self.c2.weight)
        nn.init.zeros_(self.c2.bias)

    def forward(self, x):
        return x + self.c2(F.silu(self.n2(self.c1(F.silu(self.n1(x))))))


class PlainRes(nn.Module):
    """Without norm: the full-resolution head must keep absolute colours."""

    def __init__(self, c):
        super().__init__()
        self.c1, self.c2 = nn.Conv2d(c, c, 3, padding=1), nn.Conv2d(c, c, 3, padding=1)
        nn.init.zeros_(self.c2.weight)
        nn.init.zeros_(self.c2.bias)

    def forward(self, x):
        return x + self.c2(F.silu(self.c1(F.silu(x))))


class Block(nn.Module):
    """Self attention, attention to the neighbours' tokens, feed-forward with a 3x3 depthwise."""

    def __init__(self, c, heads):
        super().__init__()
        self.heads = heads
        self.ln1, self.ln2, self.ln3 = nn.LayerNorm(c), nn.LayerNorm(c), nn.LayerNorm(c)
        self.qkv, self.o1 = nn.Linear(c, 3 * c), nn.Linear(c, c)
        self.q, self.kv, self.o2 = nn.Linear(c, c), nn.Linear(c, 2 * c), nn.Linear(c, c)
        self.f1, self.dw, self.f2 = nn.Linear(c, 3 * c), nn.Conv2d(3 * c, 3 * c, 3, padding=1, groups=3 * c), nn.Linear(3 * c, c)

    def split(self, x):
        return x.reshape(x.shape[0], x.shape[1], self.heads, -1).transpose(1, 2)

    def join(self, x):
        return x.transpose(1, 2).flatten(2)

    def forward(self, x, gather, hw):
        c = x.shape[2]
        q, k, v = self.qkv(self.ln1(x)).split(c, 2)
        x = x + self.o1(self.join(F.scaled_dot_product_attention(self.split(q), self.split(k), self.split(v))))
        y = self.ln2(x)
        k, v = gather(self.kv(y)).split(c, 2)
        x = x + self.o2(self.join(F.scaled_dot_product_attention(self.split(self.q(y)), self.split(k), self.split(v))))
        y = self.f1(self.ln3(x))
        z = y.transpose(1, 2).reshape(y.shape[0], y.shape[2], hw[0], hw[1])
        z = F.silu(z + self.dw(z))
        return x + self.f2(z.flatten(2).transpose(1, 2))


def pixel_grid(h, w, ref):
    """[h*w, 3] homogeneous pixel centres in 0..1."""
    y = (torch.arange(h, device=ref.device, dtype=torch.float32) + 0.5) / h
    x = (torch.arange(w, device=ref.device, dtype=torch.float32) + 0.5) / w
    gx, gy = x[None, :].expand(h, w), y[:, None].expand(h, w)
    return torch.stack([gx, gy, torch.ones_like(gx)], -1).reshape(-1, 3)


def full_precision():
    """Camera arithmetic never runs in bf16."""
    return torch.autocast("cuda", enabled=False)


class Warp:
    """Maps pixels of each view into its neighbours: position = A p + t / z, all normalised."""

    def __init__(self, K, c2w, neighbors):
        B, V, N = neighbors.shape
        self.B, self.V, self.N = B, V, N
        base = torch.arange(B, device=K.device)[:, None, None] * V
        self.index = (base + neighbors).reshape(-1)  # [B*V*N] rows of flattened views
        K, c2w = K.reshape(B * V, 3, 3), c2w.reshape(B * V, 4, 4)
        R, t = c2w[:, :3, :3], c2w[:, :3, 3]
        Kn, Rn, tn = K[self.index], R[self.index], t[self.index]
        RnT = Rn.transpose(1, 2)
        with full_precision():
            self.A = Kn @ (RnT @ own_rows(R, N)) @ own_rows(inverse_k(K), N)
            self.t = (Kn @ (RnT @ (own_rows(t, N) - tn)[..., None]))[..., 0]

    def gather(self, x):
        """Rows of the neighbours: [B*V, ...] -> [B*V*N, ...]."""
        return x.index_select(0, self.index)

    def tokens(self, x):
        """Neighbours' tokens side by side: [B*V, T, C] -> [B*V, N*T, C]."""
        y = self.gather(x)
        return y.reshape(self.B * self.V, self.N * x.shape[1], x.shape[2])

    def project(self, grid, inv_z):
        """grid [P,3]; inv_z [B*V, D, P] -> positions [B*V*N, D, P, 2] in -1..1, w/z, in-front mask."""
        with full_precision():
            base = torch.matmul(grid, self.A.transpose(1, 2))  # [BVN, P, 3]
        p = base[:, None] + self.t[:, None, None] * own_rows(inv_z, self.N)[..., None]
        w = p[..., 2]
        front = w > 1e-4
        xy = p[..., :2] / torch.where(front, w, torch.ones_like(w))[..., None] * 2 - 1
        xy = torch.where(front[..., None], xy, torch.full_like(xy, 4.0)).clamp(-4, 4)
        inside = front & (xy.abs().amax(-1) <= 1)
        return xy, w, inside


def inverse_k(K):
    """Inverse of [fx 0 cx; 0 fy cy; 0 0 1]."""
    fx, fy, cx, cy = K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]
    z, o = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([1 / fx, z, -cx / fx, z, 1 / fy, -cy / fy, z, z, o], -1).reshape(-1, 3, 3)


def sample(x, xy):
    """x [M,C,h,w] at xy [M,D,P,2] -> [M,C,D,P] (bilinear, zeros outside)."""
    return F.grid_sample(x, xy, mode="bilinear", padding_mode="zeros", align_corners=False)


def up2(x):
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


class GeometryNet(nn.Module):
    D = 64
    LOCAL = 9

    def __init__(self, c2=48, c4=96, c8=192, heads=6, blocks=6, match=48, groups=2):
        super().__init__()
        self.groups = groups
        self.stem = nn.Conv2d(12, c2, 3, padding=1)
        self.e2 = nn.Sequential(Res(c2), Res(c2))
        self.d4 = nn.Conv2d(c2, c4, 3, stride=2, padding=1)
        self.e4 = nn.Sequential(Res(c4), Res(c4), Res(c4))
        self.d8 = nn.Conv2d(c4, c8, 3, stride=2, padding=1)
        self.e8 = nn.Sequential(Res(c8), Res(c8))
        self.ray = nn.Linear(6, c8)
        self.blocks = nn.ModuleList(Block(c8, heads) for _ in range(blocks))
        self.u4 = nn.Conv2d(c8, c4, 1)
        self.f4 = nn.Sequential(nn.SiLU(), nn.Conv2d(c4, c4, 3, padding=1), Res(c4))
        self.m4 = nn.Conv2d(c4, match, 1)
        self.temp4 = nn.Parameter(torch.tensor(3.0))
        self.vis = nn.Parameter(torch.tensor(2.0))

        cu = 128
        self.cost_in = nn.Conv2d(2 * groups * self.D, cu, 1)
        self.cost_f = nn.Conv2d(c4, cu, 1)
        self.g4a = nn.Sequential(Res(cu), Res(cu))
        self.gd = nn.Conv2d(cu, c8, 3, stride=2, padding=1)
        self.gf8 = nn.Conv2d(c8, c8, 1)
        self.g8 = nn.Sequential(Res(c8), Res(c8))
        self.g8x = nn.ModuleList(Block(c8, heads) for _ in range(2))
        self.gu = nn.Conv2d(c8, cu, 3, padding=1)
        self.g4b = Res(cu)
        self.logits = nn.Sequential(nn.SiLU(), nn.Conv2d(cu, self.D, 3, padding=1))
        self.raw_cost = nn.Parameter(torch.tensor(1.0))

        ch = 64
        self.h2 = nn.Conv2d(cu, ch, 1)
        self.f2 = nn.Conv2d(c2, ch, 3, padding=1)
        self.m2 = nn.Sequential(nn.SiLU(), nn.Conv2d(ch, 32, 3, padding=1))
        self.temp2 = nn.Parameter(torch.tensor(3.0))
        self.r_in = nn.Conv2d(2 * self.LOCAL + 3, ch, 3, padding=1)
        self.r2 = nn.Sequential(Res(ch), Res(ch), Res(ch))
        self.r_out = nn.Sequential(nn.SiLU(), nn.Conv2d(ch, self.LOCAL + 1, 3, padding=1))

        cf = 32
        self.up_h = nn.Conv2d(ch, cf * 4, 1)
        self.head_in = nn.Conv2d(3 + 9 + 5, cf, 3, padding=1)
        self.head = nn.Sequential(PlainRes(cf), PlainRes(cf), PlainRes(cf))
        self.out = nn.Sequential(nn.SiLU(), nn.Conv2d(cf, 14, 3, padding=1))
        last = self.out[1]
        nn.init.normal_(last.weight, std=1e-3)
        with torch.no_grad():
            last.bias.zero_()
            last.bias[1] = 0.8  # opacity
            last.bias[2:5] = -0.6  # scales, log of pixels

    def aggregate(self, cost, inside, warp):
        """Mean over neighbours weighted by visibility, beside the plain mean.

        cost [B*V*N, C, P], inside [B*V*N, D, P] -> [B*V, 2C, P].
        """
        BV, N = warp.B * warp.V, warp.N
        c = cost.reshape(BV, N, *cost.shape[1:])
        seen = inside.reshape(BV, N, *inside.shape[1:]).to(c.dtype)
        seen = seen.mean(2, keepdim=True)
        best = c.amax(2, keepdim=True)
        w = torch.softmax(best * self.vis + torch.log(seen + 1e-3), 1)
        mean = (c * seen).sum(1) / (seen.sum(1) + 1e-3)
        return torch.cat([(c * w).sum(1), mean], 1), w

    def sweep(self, feat, inv_z, warp, grid, temp, groups):
        """Correlation of each view's features with its neighbours' at the hypotheses.

        feat [B*V,C,h,w] unit over each group; inv_z [B*V,D,P]. -> [B*V*N, groups*D, P], inside.
        """
        xy, _, inside = warp.project(grid, inv_z)
        src = sample(warp.gather(feat), xy)  # [BVN,C,D,P]
        m, c, d, p = src.shape
        own = own_rows(feat.flatten(2), warp.N).unsqueeze(2)
        cost = (src * own).reshape(m, groups, c // groups, d, p).sum(2) * temp
        return cost.reshape(m, groups * d, p), inside

    def unit(self, x, groups):
        b, c, h, w = x.shape
        return F.normalize(x.reshape(b, groups, c // groups, h, w).float(), dim=2).reshape(b, c, h, w)

    def forward(self, images, K, c2w, near, far, neighbors):
        """images [B,V,3,H,W], K [B,V,3,3] normalised, c2w [B,V,4,4], near/far [B,V],
        neighbors [B,V,N] -> dict of per-pixel tensors, camera frame, model units."""
        B, V, _, H, W = images.shape
        BV = B * V
        h2, w2, h4, w4, h8, w8 = H // 2, W // 2, H // 4, W // 4, H // 8, W // 8
        img = images.reshape(BV, 3, H, W)
        K2, P2 = K.reshape(BV, 3, 3).float(), c2w.reshape(BV, 4, 4).float()
        warp = Warp(K.float(), c2w.float(), neighbors)
        inv_lo, inv_hi = 1.0 / far.reshape(BV, 1, 1).float(), 1.0 / near.reshape(BV, 1, 1).float()
        span = inv_hi - inv_lo

        # Encoder.
        x = F.pixel_unshuffle(img - 0.5, 2) * 2.0
        x2 = self.e2(self.stem(x))
        x4 = self.e4(self.d4(x2))
        x8 = self.e8(self.d8(x4))
        with full_precision():
            ray = torch.matmul(pixel_grid(h8, w8, img), inverse_k(K2).transpose(1, 2))
            ray = F.normalize(torch.matmul(ray, P2[:, :3, :3].transpose(1, 2)), dim=-1)
        pose = torch.cat([ray, P2[:, None, :3, 3].expand(-1, h8 * w8, -1)], -1)
        tok = x8.flatten(2).transpose(1, 2) + self.ray(pose.to(x8.dtype))
        for blk in self.blocks:
            tok = blk(tok, warp.tokens, (h8, w8))
        x8 = tok.transpose(1, 2).reshape(BV, -1, h8, w8)
        x4 = self.f4(x4 + up2(self.u4(x8)))

        # Plane sweep at 1/4.
        steps = torch.linspace(0, 1, self.D, device=img.device)
        feat = self.unit(self.m4(x4), self.groups)
        g4 = pixel_grid(h4, w4, img)
        inv_z = inv_lo + steps[None, :, None] * span
        cost, inside = self.sweep(feat, inv_z.expand(-1, -1, h4 * w4), warp, g4, self.temp4, self.groups)
        agg, _ = self.aggregate(cost, inside, warp)
        agg = agg.reshape(BV, -1, h4, w4)
        y = self.cost_in(agg) + self.cost_f(x4)
        y4 = self.g4a(y)
        y8 = self.g8(self.gd(y4) + self.gf8(x8))
        tok = y8.flatten(2).transpose(1, 2)
        for blk in self.g8x:
            tok = blk(tok, warp.tokens, (h8, w8))
        y8 = tok.transpose(1, 2).reshape(BV, -1, h8, w8)
        y4 = self.g4b(y4 + up2(self.gu(y8)))
        raw = agg[:, : self.groups * self.D].reshape(BV, self.groups, self.D, h4, w4).sum(1)
        logits = (self.logits(y4) + self.raw_cost * raw).float()
        prob = torch.softmax(logits, 1)
        u4 = (prob * steps[None, :, None, None]).sum(1, keepdim=True)
        conf4 = prob.amax(1, keepdim=True)

        # Local sweep at 1/2.
        step = 1.0 / (self.D - 1)
        u2, c2 = up2(u4), up2(conf4)
        hid = up2(self.h2(y4)) + self.f2(x2)
        feat = self.unit(self.m2(hid), 1)
        off = (torch.arange(self.LOCAL, device=img.device) - self.LOCAL // 2) * (step / 4)
        loc = (u2.flatten(2) + off[None, :, None]).clamp(min=-0.05)
        inv_z = (inv_lo + loc * span).clamp(min=1e-6)
        g2 = pixel_grid(h2, w2, img)
        cost, inside = self.sweep(feat, inv_z, warp, g2, self.temp2, 1)
        agg, _ = self.aggregate(cost, inside, warp)
        agg = agg.reshape(BV, -1, h2, w2)
        extra = torch.cat([u2 * 2 - 1, c2, (span / inv_hi).reshape(BV, 1, 1, 1).expand(-1, 1, h2, w2)], 1)
        hid = self.r2(hid + self.r_in(torch.cat([agg.to(hid.dtype), extra.to(hid.dtype)], 1)))
        r = self.r_out(hid).float()
        pl = torch.softmax(r[:, : self.LOCAL] + agg[:, : self.LOCAL].float(), 1)
        u2 = u2 + (pl * off[None, :, None, None]).sum(1, keepdim=True) + torch.tanh(r[:, self.LOCAL :]) * step

        # Full resolution: colours of the neighbours at the depth and just before and behind it.
        u1, c1 = up2(u2), up2(c2)
        g1 = pixel_grid(H, W, img)
        off = torch.stack([torch.zeros_like(inv_lo), torch.ones_like(inv_lo), -torch.ones_like(inv_lo)], 1)[:, :, 0] * (step / 8)
        inv_z = (inv_lo + (u1.flatten(2) + off) * span).clamp(min=1e-6)
        xy, w, inside = warp.project(g1, inv_z)
        z1 = 1.0 / inv_z[:, :1]
        both = torch.cat([img.float(), z1.reshape(BV, 1, H, W)], 1)
        src = sample(warp.gather(both), xy)  # [BVN,4,3,P]
        n = warp.N
        inside1 = inside[:, :1].reshape(BV, n, 1, H * W).float()
        diff = (src[:, :3] - own_rows(img.flatten(2), n).unsqueeze(2)).reshape(BV, n, 9, H * W)
        err = diff.reshape(BV, n, 3, 3, H * W)[:, :, :, 0].abs().mean(2, keepdim=True)
        # w / inv_z is the depth in the neighbour; its own depth map at that place should say the same.
        zn = (w[:, :1] / own_rows(inv_z[:, :1], n)).reshape(BV, n, 1, H * W)
        gap = (zn / src[:, 3:4, 0].reshape(BV, n, 1, H * W).clamp(min=1e-4) - 1.0).clamp(-0.5, 0.5) * 4
        gap = torch.where(inside1 > 0, gap, torch.zeros_like(gap))
        wt = torch.softmax(torch.where(inside1 > 0, -20.0 * err - 4.0 * gap.abs(), torch.full_like(err, -30.0)), 1)
        any_in = inside1.amax(1)
        d9 = (diff * wt).sum(1) * any_in
        info = torch.cat([d9, (err * wt).sum(1) * any_in, (gap * wt).sum(1), inside1.mean(1), u1.flatten(2) * 2 - 1, c1.flatten(2)], 1)
        info = info.reshape(BV, 14, H, W)
        f = F.pixel_shuffle(self.up_h(hid), 2) + self.head_in(torch.cat([img * 2 - 1, info], 1))
        o = self.out(self.head(f)).float()

        u = u1 + torch.tanh(o[:, 0:1]) * step
        inv_z = (inv_lo[..., None] + u * span[..., None]).clamp(min=1e-6)
        z = (1.0 / inv_z)[:, 0]  # [BV,H,W]
        fx, fy = K2[:, 0, 0][:, None, None], K2[:, 1, 1][:, None, None]
        cx, cy = K2[:, 0, 2][:, None, None], K2[:, 1, 2][:, None, None]
        gx, gy = g1[:, 0].reshape(H, W), g1[:, 1].reshape(H, W)
        px = gx + torch.tanh(o[:, 12]) / W
        py = gy + torch.tanh(o[:, 13]) / H
        means = torch.stack([(px - cx) / fx * z, (py - cy) / fy * z, z], -1)
        foot = z / (fx * W)
        scales = foot[..., None] * torch.exp(o[:, 2:5].clamp(-3.0, 2.0)).permute(0, 2, 3, 1)
        quats = F.normalize(o[:, 5:9].permute(0, 2, 3, 1) + torch.tensor([1.0, 0, 0, 0], device=o.device), dim=-1)
        opac = torch.sigmoid(o[:, 1] * 2.0)
        color = (img.float() + 0.5 * torch.tanh(o[:, 9:12])).permute(0, 2, 3, 1)
        sh = ((color - 0.5) / SH_C0).unsqueeze(-2)
        v = lambda t: t.reshape(B, V, *t.shape[1:])
        return {
            "means": v(means), "scales": v(scales), "quats": v(quats), "opacities": v(opac), "sh": v(sh),
            "confidence": v(c1[:, 0].float().clamp(0, 1)),
            "u4": v(u4[:, 0]), "u2": v(u2[:, 0]), "u1": v(u[:, 0]), "logits": v(logits),
        }


def own_rows(x, n):
    """[B*V, ...] -> [B*V*n, ...], each row n times."""
    return x.unsqueeze(1).expand(-1, n, *x.shape[1:]).reshape(x.shape[0] * n, *x.shape[1:])


class Exported(nn.Module):
    """The ONNX signature: one set of views, no batch."""

    NAMES = ["means", "scales", "quats", "opacities", "sh", "confidence"]

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, images, intrinsics, camera_to_world, near, far, neighbors):
        out = self.net(images[None], intrinsics[None], camera_to_world[None], near[None], far[None], neighbors[None])
        return tuple(out[k][0] for k in self.NAMES)
