"""all-MiniLM-L6-v2 (Apache-2.0) in plain PyTorch, from `minilm.npz`: the teacher of the text tower."""
import numpy as np
import torch
import torch.nn.functional as F


class MiniLM:
    def __init__(self, path, device):
        z = np.load(path)
        self.w = {}
        for k in z.files:
            if k.endswith(".q"):
                self.w[k[:-2]] = (torch.from_numpy(z[k]).float() * torch.from_numpy(z[k[:-2] + ".s"])).to(device)
            elif not k.endswith(".s"):
                self.w[k] = torch.from_numpy(z[k]).float().to(device)
        self.device = device

    def linear(self, x, name):
        return F.linear(x, self.w[name + ".weight"], self.w[name + ".bias"])

    def norm(self, x, name):
        return F.layer_norm(x, (384,), self.w[name + ".weight"], self.w[name + ".bias"], 1e-12)

    @torch.no_grad()
    def embed(self, ids, mask):
        """ids, mask [B,T] -> unit [B,384]."""
        w, (b, t) = self.w, ids.shape
        x = w["embeddings.word_embeddings.weight"][ids] + w["embeddings.position_embeddings.weight"][:t] + w["embeddings.token_type_embeddings.weight"][0]
        x = self.norm(x, "embeddings.LayerNorm")
        bias = torch.where(mask > 0, 0.0, -1e9)[:, None, None]
        for n in range(6):
            p = f"encoder.layer.{n}."
            q, k, v = [self.linear(x, p + "attention.self." + s).reshape(b, t, 12, 32).transpose(1, 2) for s in ("query", "key", "value")]
            y = F.scaled_dot_product_attention(q, k, v, attn_mask=bias.expand(b, 1, t, t)).transpose(1, 2).reshape(b, t, 384)
            x = self.norm(x + self.linear(y, p + "attention.output.dense"), p + "attention.output.LayerNorm")
            y = self.linear(F.gelu(self.linear(x, p + "intermediate.dense")), p + "output.dense")
            x = self.norm(x + y, p + "output.LayerNorm")
        m = mask[..., None].float()
        return F.normalize((x * m).sum(1) / m.sum(1).clamp(min=1), dim=-1)


def ragged(tokens, at, rows, most, device):
    """Rows of a packed list of tokens as ids, mask [B,T], at most `most` long."""
    lens = (at[rows + 1] - at[rows]).clamp(max=most)
    t = int(lens.max())
    pos = torch.arange(t, device=device)
    mask = pos < lens[:, None]
    ids = tokens[(at[rows][:, None] + pos).clamp(max=len(tokens) - 1)]
    return torch.where(mask, ids, 0), mask.long()


def embed_all(net, tokens, at, device, batch=4096):
    out = []
    for i in range(0, len(at) - 1, batch):
        rows = torch.arange(i, min(i + batch, len(at) - 1), device=device)
        out.append(net.embed(*ragged(tokens, at, rows, 40, device)))
    return torch.cat(out)
