"""What the trainings of the image tower share: words and what is true of a class, losses, steps.

A *margin* of a word is its cosine less that of the nearest canon phrase: the product finds a word where it is positive.
"""
import math
import os

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F



class Words:
    """words.npz of a pack: `text` [W,384] and `canon` of unit length, `truth` [classes + 1, W] (1 true, 0 false, -1 open), `own`, the word
    of each class; `own_words` and `own_of`: the different ones, and which of them a class has."""

    def __init__(self, pack, device):
        z = np.load(os.path.join(pack, "words.npz"))
        get = lambda n: torch.from_numpy(z[n]).to(device)
        self.words = [str(w) for w in z["words"]]
        self.text, self.canon = F.normalize(get("embed").float(), dim=-1), F.normalize(get("canon").float(), dim=-1)
        self.truth, self.own = get("truth"), get("own").long()
        self.colours, self.everyday = get("colours").long(), get("everyday").long()
        self.thousand = self.own[get("thousand").long()]
        self.own_words, self.own_of = torch.unique(self.own, return_inverse=True)
        self.withheld = get("withheld") if "withheld" in z.files else None

    def margins(self, f, words=None):
        """[B,W] of unit vectors; of some words, [B,len(words)]."""
        text = self.text if words is None else self.text[words]
        return f @ text.T - (f @ self.canon.T).amax(1, keepdim=True)


def which_name(cos, want, truth, own_words, scale, log_prior=0.0, seen=None):
    """Cross entropy [B] of the names: cos [B,W], `want` [B] among `own_words`. Words that are true or open of a picture are no rivals;
    nor are names that are not `seen`."""
    away = (truth[:, own_words] != 0) & ~F.one_hot(want, len(own_words)).bool()
    if seen is not None:
        away = away | ~seen
    return F.cross_entropy((scale * cos[:, own_words] + log_prior).masked_fill(away, -1e4), want, reduction="none")


def which_words(margin, truth, own, weight=1.0):
    """The product's own question for every word, [B]: margins [B,W] that are scaled, `own` [B] the word of the name. Half of what is
    true is the name itself, half what it is a kind of. Thousands of words are false of a picture: those that come near count
    most, each by `weight` [W]."""
    pos, neg = (truth == 1).float(), (truth == 0).float() * weight
    itself = F.one_hot(own, pos.shape[1]) * pos
    rest = pos - itself
    true = (F.softplus(-margin) * (itself + rest / rest.sum(1, keepdim=True).clamp(min=1))).sum(1) / 2
    near = neg * (margin.detach().sigmoid() + 0.01)
    false = (F.softplus(margin) * near).sum(1) / near.sum(1).clamp(min=1e-3)
    return 2 * true + 1.5 * false


def opinion_loss(logits, opinion):
    """[B]: how far from EfficientNet-Lite2's opinion `logits` [B,1000] are."""
    return F.kl_div(logits.log_softmax(-1), (opinion / 1.5).softmax(-1), reduction="none").sum(-1)


def imagined(embed, features, fc, n):
    """Embeddings [n,384] of features as EfficientNet-Lite2 would have of `n` of its thousand classes, and those classes: pictures of most
    of them are not here, what it knows of them is in its last matrix `fc`."""
    k = torch.randint(0, 1000, (n,), device=features.device)
    base = features.detach()[torch.randint(0, len(features), (n,), device=features.device)].float()
    push = 6 + 8 * torch.rand(n, 1, device=features.device)
    return embed((0.6 * base + push * fc.weight[k] / fc.weight[k].square().sum(1, keepdim=True)).clamp(min=0)), k


def imagined_loss(f, k, text, canon, scale):
    """Of what `imagined` gives: `text` [1000,384] are the names of the classes."""
    cos = f @ text.T
    margin = cos.gather(1, k[:, None])[:, 0] - (f @ canon.T).amax(1)
    return F.cross_entropy(scale[0] * cos, k) + F.softplus(-margin * scale[1].clamp(max=40)).mean()


def mean_of(loss, named):
    """The mean of losses [B] over the pictures that have a name."""
    return (loss * named).sum() / named.sum().clamp(min=1)


class Steps:
    """AdamW with a learning rate that rises and falls over the run, and the running mean of the weights, `mean`.

    `groups`: as AdamW takes them, each with `k`, its share of `lr`."""

    def __init__(self, module, groups, lr, heat, most):
        self.module, self.lr, self.heat, self.most, self.step = module, lr, heat, most, 0
        self.opt = torch.optim.AdamW(groups, lr=lr, betas=(0.9, 0.99))
        state = module.state_dict()
        self.mean = {k: v.detach().clone() for k, v in state.items()}
        names = [k for k, v in state.items() if v.is_floating_point()]
        self.live, self.kept = [state[k] for k in names], [self.mean[k] for k in names]

    def take(self, loss, t):
        """One step; `t` is the share of the run that is over."""
        for group in self.opt.param_groups:
            group["lr"] = self.lr * group["k"] * min(1, (self.step + 1) / self.heat) * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * min(t, 1))))
        self.opt.zero_grad(set_to_none=True)
        loss.backward()
        if torch.isfinite(nn.utils.clip_grad_norm_(self.module.parameters(), 2.0)):
            self.opt.step()
        with torch.no_grad():
            torch._foreach_lerp_(self.kept, self.live, 1 - min(self.most, (self.step + 1) / (self.step + 10)))
        self.step += 1


def saved(state, path):
    """Writes weights in half precision; a file that is there is whole."""
    torch.save({k: v.half().cpu() if v.is_floating_point() else v.cpu() for k, v in state.items()}, path + ".tmp")
    os.replace(path + ".tmp", path)
