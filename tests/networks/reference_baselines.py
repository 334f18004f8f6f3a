"""The baselines once more, as plainly as their papers and the protocol state them.

Parameters bear the names of the authors' release where it has such a network.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class ReferenceResidual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.cnn = nn.Sequential(nn.Conv2d(64, 64, 3, 1, 1), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return x + self.cnn(x)


def reference_resnet_torso(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, 64, 8, 4),
        nn.ReLU(),
        ReferenceResidual(),
        ReferenceResidual(),
        nn.Flatten(),
    )


class ReferenceResNet(nn.Module):
    """[B, K, H, W] -> [B, F]."""

    def __init__(self, shape: tuple[int, int, int], features_dim: int) -> None:
        super().__init__()
        self.resnet = reference_resnet_torso(shape[0])
        size = self.resnet(torch.zeros(1, *shape)).shape[1]
        self.linear = nn.Sequential(nn.Linear(size, features_dim), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return self.linear(self.resnet(x))


class ReferenceCatformerAttention(nn.Module):
    def __init__(self, in_dim: int, width: int, dim: int, heads: int, project: bool) -> None:
        super().__init__()
        if project:
            self.proj = nn.Linear(in_dim, width)
        self.ln = nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.attention.out_proj = nn.Linear(width, dim)  # type: ignore[assignment]
        self.project = project

    def forward(self, x: Tensor) -> Tensor:
        x = self.ln(self.proj(x) if self.project else x)
        unseen = torch.ones(x.shape[1], x.shape[1], dtype=torch.bool).triu(1)
        return self.attention(x, x, x, attn_mask=unseen)[0]


class ReferenceCatformerFFN(nn.Module):
    def __init__(self, in_dim: int, hidden: int, dim: int) -> None:
        super().__init__()
        self.ln = nn.LayerNorm(in_dim)
        self.ffn = nn.Sequential(nn.Linear(in_dim, hidden), nn.GELU(), nn.Linear(hidden, dim))

    def forward(self, x: Tensor) -> Tensor:
        return self.ffn(self.ln(x))


class ReferenceCatformer(nn.Module):
    """[B, K, H, W] -> [B, F], every position of every layer computed."""

    def __init__(
        self,
        shape: tuple[int, int, int],
        features_dim: int,
        *,
        dim: int = 255,
        heads: int = 5,
        blocks: int = 2,
        attention_expansion: int = 1,
        ffn_expansion: int = 4,
    ) -> None:
        super().__init__()
        self.blocks = blocks
        self.resnet = reference_resnet_torso(1)
        size = self.resnet(torch.zeros(1, 1, *shape[1:])).shape[1]
        layers: dict[str, nn.Module] = {"obs_embedding": nn.Linear(size, dim)}
        for i in range(2 * blocks):
            earlier = max(i, 1) * dim
            if i % 2 == 0:
                layers[f"layer{i}_attention_layer"] = ReferenceCatformerAttention(
                    earlier, attention_expansion * dim, dim, heads, i > 0 or attention_expansion > 1
                )
            else:
                layers[f"layer{i}_ffn_layer"] = ReferenceCatformerFFN(
                    earlier, ffn_expansion * dim, dim
                )
        self.catformer = nn.ModuleDict(layers)
        self.catformer.register_parameter(
            "obs_pos_encoding", nn.Parameter(torch.randn(1, shape[0], dim))
        )
        self.ln1 = nn.LayerNorm(dim)
        self.head = nn.Sequential(nn.Linear(dim, features_dim), nn.ReLU())
        self.ln2 = nn.LayerNorm(features_dim)

    def forward(self, x: Tensor) -> Tensor:
        frames = [self.resnet(x[:, k : k + 1]) for k in range(x.shape[1])]
        tokens = self.catformer["obs_embedding"](torch.stack(frames, 1))
        tokens = tokens + self.catformer.get_parameter("obs_pos_encoding")
        outputs: list[Tensor] = []
        for i in range(2 * self.blocks):
            layer = self.catformer[f"layer{i}_{'ffn' if i % 2 else 'attention'}_layer"]
            outputs.append(layer(torch.cat(outputs, -1) if outputs else tokens))
        return self.ln2(self.head(self.ln1(outputs[-1][:, -1])))


class ReferenceTrunks(nn.Module):
    """OFENet or D2RL: [B, D] -> two of [B, F]."""

    def __init__(self, kind: str, size: int, hidden: int, layers: int = 2) -> None:
        super().__init__()
        self.kind, self.layers = kind, layers
        for trunk in ("policy", "value"):
            for i in range(layers):
                width = size + hidden * (i if kind == "ofenet" else min(i, 1))
                layer = nn.Sequential(nn.Linear(width, hidden), nn.Tanh())
                self.add_module(f"linear{i + 1}_{trunk}", layer)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self._trunk("policy", x), self._trunk("value", x)

    def _trunk(self, trunk: str, x: Tensor) -> Tensor:
        outputs = [x]
        for i in range(self.layers):
            layer = self.get_submodule(f"linear{i + 1}_{trunk}")
            read = outputs if self.kind == "ofenet" or i == 0 else [x, outputs[-1]]
            outputs.append(layer(torch.cat(read, -1)))
        return torch.cat(outputs if self.kind == "ofenet" else [x, outputs[-1]], -1)
