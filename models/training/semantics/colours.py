"""The eleven colour words, and which of them is true of a picture under a mask."""
import torch

COLOURS = "red orange yellow green blue purple pink brown black white gray".split()


def dominant_colour(rgb, keep):
    """[B,11] truth of the colour words for pictures [B,3,h,w] under masks [B,1,h,w]: 1, 0, or -1 open."""
    r, g, b = rgb.unbind(1)
    v, lo = rgb.amax(1), rgb.amin(1)
    s = (v - lo) / v.clamp(min=1e-3)
    d = (v - lo).clamp(min=1e-4)
    hue = torch.where(v == r, ((g - b) / d) % 6, torch.where(v == g, (b - r) / d + 2, (r - g) / d + 4)) * 60
    gray_like = s < 0.18
    names = [
        (hue < 14) | (hue > 345), (hue >= 14) & (hue < 42), (hue >= 42) & (hue < 68), (hue >= 68) & (hue < 165),
        (hue >= 165) & (hue < 262), (hue >= 262) & (hue < 300), (hue >= 300) & (hue <= 345),
    ]
    vivid = ~gray_like & (v > 0.2)
    pink_red = names[0] & (s < 0.55) & (v > 0.6)
    brown = vivid & names[1] & (v < 0.62)
    table = [
        vivid & names[0] & ~pink_red, vivid & names[1] & ~brown & (s > 0.4), vivid & names[2], vivid & names[3], vivid & names[4],
        vivid & names[5], vivid & (names[6] | pink_red), brown, v <= 0.2, gray_like & (v > 0.75), gray_like & (v > 0.2) & (v <= 0.75),
    ]
    n = keep.sum((1, 2, 3)).clamp(min=1)
    share = torch.stack([(t[:, None] * keep).sum((1, 2, 3)) / n for t in table], 1)
    return torch.where(share > 0.55, 1, torch.where(share < 0.06, 0, -1))
