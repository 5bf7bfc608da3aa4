"""Weights of the image tower: between the bundle's file, networks with batch norm and networks without it.

The exported file has batch norm folded into the convolutions. Then a mean of two towers is the mean of their weights.
"""
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from lite import Lite2
from words_model import SPACE

STRIDE = 32  # pixels of a photo under one cell of the feature map
NORMS = [("_conv_stem", "_bn0"), ("_conv_head", "_bn1"), ("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2")]


def normalised(x):
    """Pictures 0..1 as the tower takes them."""
    return ((x * 255 - 127) / 128)


def pairs(body):
    """(name, convolution, batch norm behind it) of a Lite2."""
    for name, m in body.named_modules():
        for conv, bn in NORMS:
            if hasattr(m, conv) and hasattr(m, bn):
                yield (name + "." if name else "") + conv, getattr(m, conv), getattr(m, bn)


def fold(module):
    """Batch norm folded into the convolution before it: what ONNX Runtime would do at each start."""
    for child in module.modules():
        names = dict(child.named_children())
        for conv, bn in NORMS:
            if conv in names and bn in names and isinstance(names[bn], nn.BatchNorm2d):
                _fold(names[conv], names[bn])
                setattr(child, bn, nn.Identity())
        if isinstance(child, nn.Sequential):
            for i in range(len(child) - 1):
                if isinstance(child[i], nn.Conv2d) and isinstance(child[i + 1], nn.BatchNorm2d):
                    _fold(child[i], child[i + 1])
                    child[i + 1] = nn.Identity()
    return module


def _fold(conv, bn):
    k = bn.weight / torch.sqrt(bn.running_var + bn.eps)
    bias = bn.bias - bn.running_mean * k + (conv.bias * k if conv.bias is not None else 0)
    conv.weight.data = conv.weight.data * k[:, None, None, None]
    conv.bias = nn.Parameter(bias.detach())


def folded(path):
    """Weights of an exported file, name -> f32: int8 with scales made whole again."""
    import onnx  # not on the machine that trains
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


@torch.no_grad()
def unfold(tower, state, pictures):
    """Puts folded weights into a tower with batch norm: its statistics are measured on `pictures`, and its scale and
    shift undo them, so that the network computes what it did."""
    hooks = []
    for name, conv, bn in pairs(tower.body):
        conv.weight.copy_(state[f"body.{name}.weight"])

        def measure(bn, inputs, bias=state[f"body.{name}.bias"]):
            x = inputs[0].float()
            mean, var = x.mean((0, 2, 3)), x.var((0, 2, 3), unbiased=False)
            bn.running_mean.copy_(mean)
            bn.running_var.copy_(var)
            bn.weight.copy_(torch.sqrt(var + bn.eps))
            bn.bias.copy_(mean + bias.to(mean.device))

        hooks.append(bn.register_forward_pre_hook(measure))
    tower.out.weight.copy_(state["out.weight"])
    tower.out.bias.copy_(state["out.bias"])
    tower.eval()
    out = tower(pictures)
    for h in hooks:
        h.remove()
    return out


def lite2_of(path):
    """EfficientNet-Lite2 of a pack, 8 bits a weight."""
    z = np.load(path)
    state = {}
    for k in z.files:
        if k.endswith(".q"):
            state[k[:-2]] = torch.from_numpy(z[k].astype(np.float32) * z[k[:-2] + ".s"])
        elif not k.endswith(".s"):
            state[k] = torch.from_numpy(z[k].astype(np.float32))
    net = Lite2()
    net.load_state_dict(state, strict=False)
    return net


def plain(body):
    """A Lite2 whose convolutions have a bias and no batch norm behind them."""
    for m in body.modules():
        for conv, bn in NORMS:
            if hasattr(m, conv) and hasattr(m, bn):
                c = getattr(m, conv)
                c.bias = nn.Parameter(torch.zeros(c.out_channels))
                setattr(m, bn, nn.Identity())
    return body


class PooledTower(nn.Module):
    """The image tower without batch norm, with two ways out.

    `cut`: squares on black [B,3,224,224] -> unit [B,384]. `dense`: whole photos [B,3,h,w] -> [B,384,h/32,w/32], not unit: its mean
    under a mask, made unit, is the thing's embedding, which is what `pooled` gives.
    """

    def __init__(self):
        super().__init__()
        self.body = plain(Lite2())
        del self.body._fc
        self.out = nn.Linear(1280, SPACE)
        self.near = nn.Linear(1280, SPACE)

    def load_folded(self, state):
        """From the weights of `folded`; the dense output begins with the last matrix of the other one."""
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

    def dense(self, maps):
        """The dense output of feature maps."""
        return F.conv2d(maps, self.near.weight[:, :, None, None], self.near.bias)

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
