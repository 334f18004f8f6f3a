"""Decision Transformer and DT_TIT once more, every token of every layer computed.

Built on ``nn.MultiheadAttention``, or on PyTorch's own functions with GPT-2's names and layouts.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tests.networks.reference import ReferenceBlock

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": F.relu,
    "gelu": F.gelu,
    "gelu_new": lambda x: (
        0.5 * x * (1 + torch.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))
    ),
    "tanh": torch.tanh,
}


class Conv1D(nn.Module):
    """GPT-2's linear layer, whose weight is [in, out]."""

    def __init__(self, in_dim: int, out_dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(in_dim, out_dim))
        self.bias = nn.Parameter(torch.randn(out_dim))

    def forward(self, x: Tensor) -> Tensor:
        return x @ self.weight + self.bias


class GPT2Layer(nn.Module):
    def __init__(self, dim: int, heads: int, inner: int, activation: str) -> None:
        super().__init__()
        self.heads, self.activation = heads, activation
        self.ln_1 = nn.LayerNorm(dim)
        self.attn = nn.ModuleDict({"c_attn": Conv1D(dim, 3 * dim), "c_proj": Conv1D(dim, dim)})
        self.attn.register_buffer("bias", torch.ones(1, 1, 8, 8).tril())  # its causal mask
        self.attn.register_buffer("masked_bias", torch.tensor(-1e4))
        self.ln_2 = nn.LayerNorm(dim)
        self.mlp = nn.ModuleDict({"c_fc": Conv1D(dim, inner), "c_proj": Conv1D(inner, dim)})

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        batch, length, dim = x.shape
        heads = self.attn["c_attn"](self.ln_1(x)).reshape(batch, length, 3, self.heads, -1)
        query, key, value = heads.permute(2, 0, 3, 1, 4)
        scores = query @ key.mT / math.sqrt(dim / self.heads)
        causal = torch.ones(length, length, dtype=torch.bool).tril()
        scores = torch.where(causal, scores, -1e4) + (1 - mask[:, None, None]) * -1e4
        mixed = (scores.softmax(-1) @ value).transpose(1, 2).reshape(batch, length, dim)
        x = x + self.attn["c_proj"](mixed)
        hidden = ACTIVATIONS[self.activation](self.mlp["c_fc"](self.ln_2(x)))
        return x + self.mlp["c_proj"](hidden)


class ReferenceDT(nn.Module):
    """Takes states [B, K, S], actions [B, K, A], returns, time steps, mask."""

    def __init__(
        self,
        state_dim: int,
        act_dim: int,
        *,
        tit: bool,
        dim: int = 16,
        layers: int = 1,
        heads: int = 1,
        inner: int = 64,
        activation: str = "relu",
        max_ep_len: int = 50,
    ) -> None:
        super().__init__()
        self.tit = tit
        self.embed_timestep = nn.Embedding(max_ep_len, dim)
        self.embed_return = nn.Linear(1, dim)
        self.embed_action = nn.Linear(act_dim, dim)
        if tit:
            self.obs_patch_embed = nn.Conv1d(1, dim, state_dim, stride=state_dim, bias=False)
            self.class_token_encoding = nn.Parameter(torch.randn(1, 1, dim))
            self.inner_blocks = nn.ModuleList([ReferenceBlock(dim, 1, 1, "relu")])
        else:
            self.embed_state = nn.Linear(state_dim, dim)
        self.embed_ln = nn.LayerNorm(dim)
        self.transformer = nn.ModuleDict(
            {
                "wte": nn.Embedding(1, dim),  # in its state dict, and not used
                "h": nn.ModuleList(GPT2Layer(dim, heads, inner, activation) for _ in range(layers)),
                "ln_f": nn.LayerNorm(dim),
            }
        )
        self.predict_state = nn.Linear(dim, state_dim)
        self.predict_action = nn.Sequential(nn.Linear(dim, act_dim), nn.Tanh())
        self.predict_return = nn.Linear(dim, 1)

    def embed_states(self, states: Tensor) -> Tensor:
        if not self.tit:
            return self.embed_state(states)
        patches = self.obs_patch_embed(states.reshape(-1, 1, states.shape[-1])).mT  # [N, 1, D]
        x = torch.cat([self.class_token_encoding.expand(len(patches), -1, -1), patches], 1)
        for block in self.inner_blocks:
            x, _ = block(x)
        return x[:, 0].reshape(*states.shape[:-1], -1)

    def forward(
        self, states: Tensor, actions: Tensor, returns: Tensor, timesteps: Tensor, mask: Tensor
    ) -> Tensor:
        time = self.embed_timestep(timesteps)
        tokens = []
        for k in range(states.shape[1]):
            tokens.append(self.embed_return(returns[:, k]) + time[:, k])
            tokens.append(self.embed_states(states[:, k]) + time[:, k])
            tokens.append(self.embed_action(actions[:, k]) + time[:, k])
        x = self.embed_ln(torch.stack(tokens, 1))
        layers = self.transformer["h"]
        assert isinstance(layers, nn.ModuleList)
        for layer in layers:
            x = layer(x, mask.repeat_interleave(3, dim=1))
        return self.predict_action(self.transformer["ln_f"](x)[:, 1::3])
