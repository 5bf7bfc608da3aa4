"""The image tower and the text tower: both end in one space of 384 numbers, unit length.

The space is MiniLM's, centred and turned by one matrix that is learnt with the image tower.
"""
import math

import torch
import torch.nn as nn
import torch.nn.functional as F

from lite import Lite2

SPACE, SIDE = 384, 224
VOCABULARY, CONTEXT, WIDTH, LAYERS = 8192, 24, 256, 4


class ImageTower(nn.Module):
    """[B,3,S,S], (x - 127) / 128 of 0..255, outside of the mask 0 before that -> unit [B,384]."""

    def __init__(self):
        super().__init__()
        self.body = Lite2()
        del self.body._fc
        self.drop = nn.Dropout(0.1)
        self.out = nn.Linear(1280, SPACE)

    def embed(self, features):
        return F.normalize(self.out(self.drop(features)).float(), dim=-1)

    def forward(self, x):
        return self.embed(self.body.head(x))


class TextTower(nn.Module):
    """ids [B,T] of tokenizer.json (0 = padding) -> unit [B,384]."""

    def __init__(self):
        super().__init__()
        self.word = nn.Embedding(VOCABULARY, WIDTH)
        self.place = nn.Parameter(torch.randn(CONTEXT, WIDTH) * 0.02)
        self.layers = nn.ModuleList([Layer(WIDTH, 4, 768) for _ in range(LAYERS)])
        self.norm = nn.LayerNorm(WIDTH)
        self.out = nn.Linear(WIDTH, SPACE)
        # The turn into the shared space, set after the image tower has learnt it.
        self.register_buffer("centre", torch.zeros(SPACE))
        self.register_buffer("turn", torch.eye(SPACE))
        nn.init.normal_(self.word.weight, std=0.05)

    def teacher_space(self, ids):
        mask = (ids > 0).float()
        x = self.word(ids) + self.place[: ids.shape[1]]
        bias = ((mask - 1) * 1e4)[:, None, None]
        for layer in self.layers:
            x = layer(x, bias)
        x = (self.norm(x) * mask[..., None]).sum(1) / mask.sum(1, keepdim=True).clamp(min=1)
        return F.normalize(self.out(x).float(), dim=-1)

    def forward(self, input_ids):
        return F.normalize((self.teacher_space(input_ids) - self.centre) @ self.turn.T, dim=-1)


class Layer(nn.Module):
    def __init__(self, dim, heads, mid):
        super().__init__()
        self.heads = heads
        self.a, self.b = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.qkv, self.o = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)
        self.up, self.down = nn.Linear(dim, mid), nn.Linear(mid, dim)

    def forward(self, x, bias):
        b, t, c = x.shape
        q, k, v = self.qkv(self.a(x)).reshape(b, t, 3, self.heads, c // self.heads).permute(2, 0, 3, 1, 4).unbind(0)
        y = ((q @ k.transpose(-1, -2)) / math.sqrt(c // self.heads) + bias).softmax(-1) @ v
        x = x + self.o(y.transpose(1, 2).reshape(b, t, c))
        return x + self.down(F.gelu(self.up(self.b(x))))
