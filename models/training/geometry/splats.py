"""Pictures of the network's Gaussians by gsplat, and how far they are from the photos."""
import torch
import torch.nn.functional as F

from model import SH_C0, pixel_grid


BLUR = 0.3  # square pixels that the renderer adds
CELLS = 16  # of the backdrop, along a side of a photo
FRONT = 4  # photos that are in front in a view
TURN_COST = 0.5  # of a radian, in steps of a median depth
OWN_SIZE = 1.25  # up to this magnification a view counts as of the photos' own size


def with_inputs(out, images, K, c2w):
    """The network's answer with what it was asked: `render` needs both."""
    return out | {"images": images, "K": K, "c2w": c2w, "fx": K[..., 0, 0]}


def render(out, c2w, K, H, W):
    """Pictures [B,T,3,H,W] of the network's Gaussians from cameras c2w [B,T,4,4], K normalised.

    Behind the Gaussians is the backdrop, as in views of the product.
    """
    B, T = c2w.shape[:2]
    behind = backdrop(out, c2w, K, H, W)
    g = world_gaussians(out)
    size = torch.tensor([[W], [H], [1]], device=K.device, dtype=torch.float32)
    views = torch.linalg.inv(c2w).flatten(0, 1).contiguous()  # [B*T,4,4]
    K = (K * size).flatten(0, 1).contiguous()
    g = {k: v.repeat_interleave(T, 0) for k, v in g.items()}
    g["scales"] = (g["scales"] ** 2 + lost_blur(g["means"], g.pop("width"), views, K)[..., None]).sqrt()
    front = in_front(out, c2w)
    if front is None:
        img, alpha = rasterized(g, views, K, W, H)
    else:  # those in front first, then the others behind them
        front = front.flatten(0, 1).repeat_interleave(out["means"][0, 0, ..., 0].numel(), 1)
        img, alpha = rasterized(g | {"opacities": g["opacities"] * front}, views, K, W, H)
        others, others_alpha = rasterized(g | {"opacities": g["opacities"] * ~front}, views, K, W, H)
        img, alpha = img + (1 - alpha) * others, alpha + (1 - alpha) * others_alpha
    return (img + (1 - alpha) * behind).permute(0, 1, 4, 2, 3).reshape(B, T, 3, H, W)


@torch.no_grad()
def backdrop(out, c2w, K, H, W):
    """The photos' colours by direction [B*T,1,H,W,3], blurred to cells: about what the product draws behind a scene.

    A photo counts less the farther outside of it a direction is.
    """
    B, T = c2w.shape[:2]
    V, h, w = out["images"].shape[1], H // 8, W // 8
    cells = F.adaptive_avg_pool2d(out["images"].float().flatten(0, 1), CELLS).reshape(B, V, 3, CELLS, CELLS)
    rays = pixel_grid(h, w, c2w) @ torch.linalg.inv(K).transpose(-1, -2)  # [B,T,P,3]
    turn = out["c2w"][:, None, :, :3, :3].transpose(-1, -2) @ c2w[:, :, None, :3, :3]  # [B,T,V,3,3]
    seen = rays[:, :, None] @ turn.transpose(-1, -2) @ out["K"][:, None].transpose(-1, -2)
    ahead = seen[..., 2:] > 1e-3
    xy = torch.where(ahead, seen[..., :2] / seen[..., 2:].clamp(min=1e-3) * 2 - 1, torch.full_like(seen[..., :2], 4.0)).clamp(-4, 4)
    weight = torch.exp(-6 * (xy.abs().amax(-1) - 1).clamp(min=0))[..., None, :, None]  # [B,T,V,1,P,1]
    source = cells[:, None].expand(-1, T, -1, -1, -1, -1).flatten(0, 2)
    colour = F.grid_sample(source, xy.flatten(0, 2)[:, :, None], padding_mode="border", align_corners=False)
    colour = colour.reshape(B, T, V, 3, h * w, 1)
    mean = ((colour * weight).sum(2) / weight.sum(2)).reshape(B * T, 3, h, w)
    return F.interpolate(mean, (H, W), mode="bilinear", align_corners=False).permute(0, 2, 3, 1)[:, None]


def rasterized(g, views, K, W, H):
    """Colours and alphas [B*T,1,H,W,...] of one layer."""
    from gsplat import rasterization

    img, alpha, _ = rasterization(
        g["means"], g["quats"], g["scales"], g["opacities"], g["colors"],
        views[:, None], K[:, None], W, H, near_plane=1e-3, packed=False,
    )
    return img[..., :3], alpha


@torch.no_grad()
def in_front(out, c2w):
    """Whether each photo's Gaussians are in front [B,T,V]; None where those of all are.

    As crates/render/src/plan.rs: the photos whose cameras are nearest to the view's, by steps in
    median depths and by turns.
    """
    own = out["c2w"].float()
    if own.shape[1] <= FRONT:
        return None
    depth = out["means"][..., 2].flatten(1).median(1).values[:, None, None]
    step = torch.cdist(c2w[..., :3, 3], own[..., :3, 3]) / depth
    turn = torch.einsum("bti,bvi->btv", c2w[..., :3, 2], own[..., :3, 2]).clamp(-1, 1).arccos()
    cost = step + TURN_COST * turn
    return cost <= cost.kthvalue(FRONT, -1, keepdim=True).values


@torch.no_grad()
def lost_blur(means, width, views, K):
    """Variance [M,N] that the product adds to Gaussians that a view magnifies: crates/render/src/plan.rs.

    means [M,N,3] of the world, width [M,N] of their source pixels, views [M,4,4] world to camera.
    """
    z = torch.einsum("mj,mnj->mn", views[:, 2, :3], means) + views[:, 2, 3:]
    focal = torch.maximum(K[:, 0, 0], K[:, 1, 1])[:, None]
    p = width * focal / z.clamp(min=1e-6)
    return torch.where((p > OWN_SIZE) & (z > 1e-3), BLUR * width**2 * (1 - 1 / p**2), torch.zeros_like(p))


def world_gaussians(out):
    m, R, t = out["means"], out["c2w"][..., :3, :3], out["c2w"][..., :3, 3]
    means = torch.einsum("bvij,bvhwj->bvhwi", R, m) + t[:, :, None, None]
    width = m[..., 2] / (out["fx"][:, :, None, None] * m.shape[3])
    return {
        "width": width.flatten(1, 3),
        "means": means.flatten(1, 3), "scales": out["scales"].flatten(1, 3),
        "quats": quat_mul(rot_to_quat(R)[:, :, None, None].expand_as(out["quats"]), out["quats"]).flatten(1, 3),
        "opacities": out["opacities"].flatten(1, 3),
        "colors": (out["sh"][..., 0, :] * SH_C0 + 0.5).clamp(min=0).flatten(1, 3),
    }


def quat_mul(a, b):
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack([
        aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
    ], -1)


def rot_to_quat(R):
    """wxyz; stable for every rotation (largest of the four components first)."""
    m = R
    t = torch.stack([
        1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2], 1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
        1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2], 1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
    ], -1)
    a, b, c = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    d, e, f = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    cand = torch.stack([
        torch.stack([t[..., 0], a - d, b - e, c - f], -1), torch.stack([a - d, t[..., 1], c + f, b + e], -1),
        torch.stack([b - e, c + f, t[..., 2], a + d], -1), torch.stack([c - f, b + e, a + d, t[..., 3]], -1),
    ], -2)
    best = t.argmax(-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    return F.normalize(torch.gather(cand, -2, best)[..., 0, :], dim=-1)


_WINDOW = {}


def ssim(x, y):
    """Mean SSIM of each picture, 11x11 Gaussian of sigma 1.5, valid windows. [M,3,H,W] -> [M]."""
    key = x.device
    if key not in _WINDOW:
        g = torch.exp(-((torch.arange(11, device=key) - 5.0) ** 2) / (2 * 1.5**2))
        _WINDOW[key] = (g / g.sum())[None, None]
    g = _WINDOW[key]
    m, c, h, w = x.shape

    def blur(t):
        t = t.reshape(m * c, 1, *t.shape[-2:])
        t = F.conv2d(F.conv2d(t, g[..., None]), g[:, :, None])
        return t.reshape(m, c, *t.shape[-2:])

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    s = ((2 * mx * my + 1e-4) * (2 * vxy + 9e-4)) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return s.flatten(1).mean(1)


def depth_loss(out, depth, near, far):
    """Inverse depth relative to the searched range at three scales, and cross entropy of the sweep."""
    inv_lo, inv_hi = 1 / far, 1 / near
    u = ((1 / depth.clamp(min=1e-4) - inv_lo[..., None, None]) / (inv_hi - inv_lo)[..., None, None]).clamp(-0.1, 1.1)
    total = 0.5 * (out["u4"] - u[..., 2::4, 2::4]).abs().mean()
    total = total + 0.7 * (out["u2"] - u[..., 1::2, 1::2]).abs().mean() + (out["u1"] - u).abs().mean()
    D = out["logits"].shape[2]
    pos = (u[..., 2::4, 2::4].clamp(0, 1) * (D - 1)).flatten(0, 1)
    lo = pos.floor().clamp(max=D - 2).long()
    f = (pos - lo)[:, None]
    logp = F.log_softmax(out["logits"].flatten(0, 1), 1)
    ce = -(logp.gather(1, lo[:, None]) * (1 - f) + logp.gather(1, lo[:, None] + 1) * f).mean()
    return total, ce, (out["u1"] - u).abs().mean()


def picture_loss(pic, want, robust=None, log_weight=0.02):
    """MSE, log MSE (the mean PSNR itself) and SSIM of pictures [M,3,H,W]; also the plain MSE.

    With `robust` an error far over it counts little more than one of its size: what moved, shone
    or was lit differently in a photo.
    """
    err = (pic - want) ** 2
    plain = err.flatten(1).mean(1)
    each = plain if robust is None else (err / (1 + err / robust**2)).flatten(1).mean(1)
    loss = 6 * each.mean() + log_weight * torch.log(each + 1e-4).mean() + 0.15 * (1 - ssim(pic, want)).mean()
    return loss, plain.mean().detach()


def nearest_views(c2w, k):
    """k nearest other views by distance of centres. [B,V,4,4] -> [B,V,k]."""
    d = torch.cdist(c2w[:, :, :3, 3], c2w[:, :, :3, 3])
    d = d + 1e6 * torch.eye(d.shape[1], device=d.device)
    return d.argsort(-1)[..., :k]
