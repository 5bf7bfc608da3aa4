"""Depth ranges of photos by a plane sweep over their neighbours, as the product finds them."""
import torch
import torch.nn.functional as F

SIDE = 128
PLANES = 192
POINTS_MIN = 30


def gray(rgb):
    """[3,h,w] 0..1 -> [1,SIDE,SIDE]; the shape is lost, normalised intrinsics stay right."""
    return F.interpolate(rgb.mean(0)[None, None], (SIDE, SIDE), mode="area")[0]


def inverse_depths(a, b, Ka, Kb, b_from_a):
    """Confident inverse depths of pictures a [M,1,S,S] seen by b: ZNCC over 7x7 windows.

    K normalised [M,3,3], poses b_from_a [M,4,4]. A list of M tensors, in the unit of the poses.
    """
    m, dev = len(a), a.device
    c = (torch.arange(SIDE, device=dev) + 0.5) / SIDE
    gy, gx = torch.meshgrid(c, c, indexing="ij")
    at = lambda K, i, j: K[:, i, j, None, None]
    rays = torch.stack([(gx - at(Ka, 0, 2)) / at(Ka, 0, 0), (gy - at(Ka, 1, 2)) / at(Ka, 1, 1), torch.ones(m, SIDE, SIDE, device=dev)], -1)
    rays = torch.einsum("mij,mhwj->mhwi", b_from_a[:, :3, :3], rays)
    t = b_from_a[:, :3, 3]
    base = t.norm(dim=1)
    invs = torch.linspace(0, 1, PLANES, device=dev)[None] / (0.6 * base)[:, None]
    blur = lambda x: F.avg_pool2d(x, 7, 1, 3)
    ma = blur(a)
    va = blur(a * a) - ma * ma
    scores = []
    for n in range(m):
        p = rays[n][None] + t[n] * invs[n, :, None, None, None]  # [PLANES,S,S,3]
        w = p[..., 2].clamp(min=1e-6)
        xy = torch.stack([p[..., 0] / w * Kb[n, 0, 0] + Kb[n, 0, 2], p[..., 1] / w * Kb[n, 1, 1] + Kb[n, 1, 2]], -1) * 2 - 1
        ok = ((xy.abs().amax(-1) < 1) & (p[..., 2] > 1e-6)).float()[:, None]
        s = F.grid_sample(b[n][None].expand(PLANES, -1, -1, -1), xy.clamp(-4, 4), align_corners=False)
        mb = blur(s)
        vb = blur(s * s) - mb * mb
        z = (blur(a[n] * s) - ma[n] * mb) / (va[n] * vb).clamp(min=1e-8).sqrt()
        z = torch.where(blur(ok) > 0.95, z, torch.full_like(z, -1))[:, 0]
        best, k = z.max(0)
        off = (torch.arange(PLANES, device=dev)[:, None, None] - k[None]).abs() > 4
        second = torch.where(off, z, torch.full_like(z, -1)).amax(0)
        good = (best > 0.85) & (best - second > 0.06) & (va[n, 0] > 2e-4) & (k > 0) & (k < PLANES - 2)
        scores.append(invs[n][k[good]])
    return scores


class Ranges:
    """Inverse depths of pairs of one capture, each pair swept once."""

    def __init__(self, pictures, K, c2w):
        """pictures: list of [1,SIDE,SIDE] or None; K [N,3,3] normalised and c2w [N,4,4] in f64."""
        self.pictures, self.K, self.c2w, self.found = pictures, K, c2w, {}

    def pair(self, i, j):
        if (i, j) not in self.found:
            p = self.pictures
            rel = (torch.linalg.inv(self.c2w[j]) @ self.c2w[i]).float()[None].to(p[i].device)
            K = self.K.float().to(p[i].device)
            self.found[i, j] = inverse_depths(p[i][None], p[j][None], K[i][None], K[j][None], rel)[0]
        return self.found[i, j]

    def bounds(self, i, partners, q=(0.02, 0.98)):
        """(farthest, nearest) inverse depth of photo i, or None."""
        all_ = torch.cat([self.pair(i, j) for j in partners]) if partners else torch.zeros(0)
        if len(all_) < POINTS_MIN:
            return None
        return torch.quantile(all_, torch.tensor(q, device=all_.device)).tolist()
