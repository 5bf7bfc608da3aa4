"""The image tower of a bundle as a network that can be trained, with a dense output beside the pooled one.

The weights are those of the exported file: batch norm is folded into the convolutions and stays so. Then a mean of
two towers is the mean of their weights, and what is trained is what is exported.
"""
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from lite import Lite2
from words_model import SPACE

STRIDE = 32  # pixels of a photo under one cell of the feature map


def folded(path):
    """Weights of an exported image tower, name -> f32: int8 with scales made whole again."""
    import onnx
    from onnx import numpy_helper

    graph = onnx.load(path).graph
    raw = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
    out = {k: torch.from_numpy(v.copy()) for k, v in raw.items() if v.dtype == np.float32 and not k.endswith("_s")}
    for n in graph.node:
        if n.op_type == "DequantizeLinear":
            axis = onnx.helper.get_node_attr_value(n, "axis")
            q, s = raw[n.input[0]].astype(np.float32), raw[n.input[1]]
            shape = [1] * q.ndim
            shape[axis] = -1
            out[n.output[0]] = torch.from_numpy(q * s.reshape(shape))
    return out


def plain(body):
    """A Lite2 whose convolutions have a bias and no batch norm behind them."""
    for m in body.modules():
        for conv, bn in [("_conv_stem", "_bn0"), ("_conv_head", "_bn1"), ("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2")]:
            if hasattr(m, conv) and hasattr(m, bn):
                c = getattr(m, conv)
                c.bias = nn.Parameter(torch.zeros(c.out_channels))
                setattr(m, bn, nn.Identity())
    return body


class PooledTower(nn.Module):
    """`cut`: squares on black -> unit [B,384]. `dense`: whole photos -> [B,384,h/32,w/32], of no length, to be pooled."""

    def __init__(self):
        super().__init__()
        self.body = plain(Lite2())
        del self.body._fc
        self.out = nn.Linear(1280, SPACE)
        self.near = nn.Linear(1280, SPACE)

    def load_folded(self, state):
        """From the weights of `folded`; the dense output begins with the last matrix of the pooled one."""
        state = {k: v.float() for k, v in state.items()}
        for k in ("weight", "bias"):
            state.setdefault("near." + k, state["out." + k].clone())
        self.load_state_dict(state)
        return self

    def maps(self, x):
        """Features before the mean [B,1280,h/32,w/32] of pictures (x - 127) / 128."""
        return F.relu6(self.body._conv_head(self.body.features(x)[-1]))

    def cut(self, x):
        return F.normalize(self.out(self.maps(x).mean((2, 3))).float(), dim=-1)

    def dense(self, x):
        return torch.einsum("bchw,oc->bohw", self.maps(x), self.near.weight) + self.near.bias[:, None, None]

    def pooled(self, x, photo, weights):
        """Unit [K,384] of K masks of photos x [B,3,H,W]: `photo` [K], sorted, says which, `weights` [K,H/32,W/32]
        how much of each cell lies under the mask."""
        m = self.maps(x).flatten(2)
        w = weights.flatten(1)
        w = (w / w.sum(1, keepdim=True).clamp(min=1e-6)).to(m.dtype)
        count = torch.bincount(photo, minlength=len(m))
        at = torch.arange(len(photo), device=photo.device) - (count.cumsum(0) - count)[photo]
        block = torch.zeros(len(m), int(count.max()), w.shape[1], dtype=m.dtype, device=m.device)
        block[photo, at] = w
        f = torch.einsum("bkn,bcn->bkc", block, m)[photo, at]
        return F.normalize(self.near(f).float(), dim=-1)


def cells(masks):
    """Share of each 32 x 32 cell that lies under masks [K,H,W] (0..1) -> [K,H/32,W/32]."""
    return F.avg_pool2d(masks[:, None].float(), STRIDE)[:, 0]


def normalised(x):
    """Pictures 0..1 as the tower takes them."""
    return ((x * 255 - 127) / 128).contiguous(memory_format=torch.channels_last)
