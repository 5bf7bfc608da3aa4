"""Changes to pictures and masks, made on the device in batches: what the trainings of the image tower share."""
import math

import torch
import torch.nn.functional as F

from pictures import box_of
from words_model import SIDE


class Augment:
    """Random changes, from one generator."""

    def __init__(self, device, seed):
        self.device, self.gen = device, torch.Generator(device=device).manual_seed(seed)

    def u(self, *s):
        return torch.rand(*s, device=self.device, generator=self.gen)

    def pick(self, weight, n):
        return torch.multinomial(weight, n, True, generator=self.gen)

    def blob(self, B, S):
        g = torch.linspace(-1, 1, S, device=self.device)
        x, y = g[None, None], g[None, :, None]
        cx, cy = ((self.u(B, 1, 1) - 0.5) * 0.5 for _ in range(2))
        rx, ry = (0.35 + self.u(B, 1, 1) * 0.6 for _ in range(2))
        noise = F.interpolate(torch.randn(B, 1, 6, 6, device=self.device, generator=self.gen), (S, S), mode="bicubic")[:, 0] * 0.22
        p = 2 + self.u(B, 1, 1) * 3
        return ((((x - cx) / rx).abs() ** p + ((y - cy) / ry).abs() ** p + noise) < 1).float()[:, None]

    def spoil(self, mask):
        """Masks [B,1,R,R] as a network draws them: ragged, coarse, a part missing, at times too much."""
        B, _, R, _ = mask.shape
        u = lambda: self.u(B, 1, 1, 1)
        k = R // 32 * 2 + 1
        soft = F.avg_pool2d(mask, k, 1, k // 2, count_include_pad=False)
        out = torch.where(u() < 0.6, (soft > 0.15 + u() * 0.7).float(), (mask > 0.5).float())
        grid = R // int(torch.randint(4, 13, (1,), device=self.device, generator=self.gen))
        rough = F.interpolate((F.interpolate(out, (grid, grid), mode="area") > 0.5).float(), (R, R), mode="nearest")
        out = torch.where(u() < 0.35, rough, out)
        # A part missing: what lies beyond a line, or under something round.
        g = torch.linspace(-1, 1, R, device=self.device)
        a, t = u() * 2 * math.pi, (u() - 0.35) * 0.9
        line = (g.view(1, 1, 1, R) * a.cos() + g.view(1, 1, R, 1) * a.sin() < 0.7 * t + 0.2).float()
        cx, cy, r = (u() - 0.5) * 1.6, (u() - 0.5) * 1.6, 0.1 + u() * 0.4
        hole = ((g.view(1, 1, 1, R) - cx) ** 2 + (g.view(1, 1, R, 1) - cy) ** 2 > r * r).float()
        which = u()
        part = torch.where(which < 0.22, line, torch.where(which < 0.42, hole, torch.ones_like(line)))
        more = torch.where(u() < 0.08, F.max_pool2d(out, k, 1, k // 2), out)
        less = more * part
        area = lambda m: m.sum((1, 2, 3), keepdim=True)
        whole = area((mask > 0.5).float())
        less = torch.where(area(less) > 0.35 * whole, less, more)
        less = torch.where(area(less) > 0.3 * whole, less, (mask > 0.5).float())
        return torch.where(area(less) > 8, less, torch.ones_like(less))

    def cut(self, bank, mask, dim):
        """Windows [B,3,R,R] 0..1 and masks [B,1,R,R] -> [B,3,S,S], [B,1,S,S]: the box of the mask, as the server cuts it.

        `dim` [B]: whether what lies around is to be seen, and so a margin is wanted.
        """
        B = len(bank)
        (cx, cy), (w, h) = box_of(mask[:, 0] > 0.5)
        side = torch.maximum(w, h)
        margin = torch.where(dim, 0.1 + self.u(B) * 0.2, (self.u(B) - 0.3).clamp(min=0) * 0.1)
        k = side / 2 * (1 + 2 * margin) * torch.exp((self.u(B) - 0.5) * 0.06)
        a = torch.where(self.u(B) < 0.6, (self.u(B) - 0.5) * 0.5, torch.zeros(B, device=self.device))
        flip = torch.where(self.u(B) < 0.5, -1.0, 1.0)
        stretch = torch.exp((self.u(B) - 0.5) * 0.24)
        theta = torch.stack([torch.stack([k * flip * stretch * a.cos(), -k * a.sin(), cx], -1), torch.stack([k * flip * a.sin(), k / stretch * a.cos(), cy], -1)], 1)
        both = F.grid_sample(torch.cat([bank, mask], 1), F.affine_grid(theta, (B, 1, SIDE, SIDE), align_corners=False), align_corners=False)
        return both[:, :3], (both[:, 3:] > 0.5).float()

    def soften(self, x, share=0.45, sizes=6, least=24 / SIDE, span=1.7):
        """`share` of the pictures [B,3,H,W] as if they were small, or far, or out of focus (`sizes` sizes, from `least` of their own up to e^span
        times that), and some grainy."""
        B, _, H, W = x.shape
        out = x.clone()
        for rows in torch.randperm(B, device=self.device, generator=self.gen)[: int(share * B)].chunk(sizes):
            if len(rows):
                k = least * math.exp(float(self.u(1)) * span)
                small = F.interpolate(x[rows], (int(H * k), int(W * k)), mode="bilinear", antialias=True)
                out[rows] = F.interpolate(small, (H, W), mode="bilinear").clamp(0, 1)
        noise = self.u(B, 1, 1, 1) * 0.05 * (self.u(B, 1, 1, 1) < 0.4)
        grain = F.interpolate(torch.randn(B, 3, H // 2, W // 2, device=self.device, generator=self.gen), (H, W), mode="bilinear")
        return (out + grain * noise).clamp(0, 1)

    def recolour(self, x):
        B = len(x)
        gain = torch.exp((self.u(B, 3, 1, 1) - 0.5) * 0.25 + (self.u(B, 1, 1, 1) - 0.5) * 0.9)
        c = torch.exp((self.u(B, 1, 1, 1) - 0.5) * 0.5)
        gray = x.mean(1, keepdim=True)
        x = gray + (x - gray) * (0.55 + self.u(B, 1, 1, 1) * 0.7)
        return (((x * gain) - 0.4) * c + 0.4).clamp(0, 1)
