"""Catformer: a transformer whose layers are concatenated instead of added."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit.networks.attention import Read, SelfAttention
from torchrl_tit.networks.config import check_positive, override_config
from torchrl_tit.networks.history_network import HistoryNetwork, make_head
from torchrl_tit.networks.images import check_image
from torchrl_tit.networks.resnet import SMALLEST_IMAGE, ResNetFrameEncoder


@dataclass(frozen=True, kw_only=True)
class CatformerConfig:
    """Hyperparameters of Catformer, by default those of arXiv 2212.14538."""

    embed_dim: int = 255
    """Width D of a token and of every layer's output."""
    num_blocks: int = 2
    """Number of pairs of an attention layer and an FFN layer."""
    num_heads: int = 5
    """Attention heads; must divide ``attention_expansion`` x ``embed_dim``."""
    attention_expansion: int = 1
    """Width at which attention works as a multiple of ``embed_dim`` (2 in its paper's tuning)."""
    ffn_expansion: int = 4
    """Hidden width of an FFN as a multiple of ``embed_dim``."""
    features_dim: int = 512
    """Size of the features that the network puts out."""

    def __post_init__(self) -> None:
        check_positive(
            self, "embed_dim", "num_blocks", "attention_expansion", "ffn_expansion", "features_dim"
        )


class CatformerAttention(nn.Module):
    """Attention layer: project the concatenation, LayerNorm, causal self-attention.

    Args:
        in_dim: width of the concatenation of all earlier layers' outputs.
        config: hyperparameters.
        project: whether there is a projection; without it ``in_dim`` is the attention's width.
    """

    def __init__(self, in_dim: int, config: CatformerConfig, *, project: bool) -> None:
        super().__init__()
        width = config.attention_expansion * config.embed_dim
        self.projection = nn.Linear(in_dim, width) if project else nn.Identity()
        self.norm = nn.LayerNorm(width)
        self.attention = SelfAttention(
            width, config.num_heads, causal=True, out_dim=config.embed_dim
        )

    def forward(self, x: Tensor, read: Read = "all") -> Tensor:
        """Float [N, K, in_dim] -> float [N, K or 1, D]."""
        return self.attention(self.norm(self.projection(x)), read)

    def attention_weights(self, x: Tensor) -> Tensor:
        """Returns the weights with which this layer attends, float [N, heads, K, K]."""
        return self.attention.weights(self.norm(self.projection(x)))


class CatformerEncoder(nn.Module):
    """Catformer's layers over the tokens of K steps, read at the last step.

    Attention and FFN take turns, without residuals: each layer after the first reads the
    concatenation of the outputs of all layers before it (not of the tokens themselves).

    Args:
        history: number of steps K.
        config: hyperparameters.

    Example:
        >>> encoder = CatformerEncoder(4, CatformerConfig(embed_dim=32, num_heads=4))
        >>> encoder(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    def __init__(self, history: int, config: CatformerConfig) -> None:
        super().__init__()
        width = config.embed_dim
        self.positions = nn.Parameter(torch.empty(1, history, width))
        self.attentions = nn.ModuleList()
        self.ffns = nn.ModuleList()
        for index in range(config.num_blocks):
            # The first layer reads the tokens as they are, unless it is to be wider.
            project = index > 0 or config.attention_expansion > 1
            earlier = width * max(2 * index, 1)
            self.attentions.append(CatformerAttention(earlier, config, project=project))
            earlier = width * (2 * index + 1)
            self.ffns.append(
                nn.Sequential(
                    nn.LayerNorm(earlier),
                    nn.Linear(earlier, config.ffn_expansion * width),
                    nn.GELU(),
                    nn.Linear(config.ffn_expansion * width, width),
                )
            )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises the temporal positions: normal with a standard deviation of 0.02."""
        nn.init.normal_(self.positions, std=0.02)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K steps, float [..., K, 1, D] -> float [..., D]."""
        x, leading = self._steps(tokens)  # [N, K, D]
        outputs: list[Tensor] = []  # of all layers so far, [N, K, D] each
        for index, (attention, ffn) in enumerate(zip(self.attentions, self.ffns, strict=True)):
            x = torch.cat(outputs, dim=-1) if outputs else x
            if index == len(self.ffns) - 1:  # of the last two layers only the last step is read
                outputs = [output[:, -1:] for output in outputs]
                outputs.append(attention(x, read="last"))
            else:
                outputs.append(attention(x))
            outputs.append(ffn(torch.cat(outputs, dim=-1)))
        return outputs[-1].reshape(*leading, tokens.shape[-1])

    def attention_maps(self, tokens: Tensor) -> list[Tensor]:
        """Returns the attention weights of each attention layer, float [..., heads, K, K]."""
        x, leading = self._steps(tokens)
        outputs: list[Tensor] = []
        maps = []
        for attention, ffn in zip(self.attentions, self.ffns, strict=True):
            x = torch.cat(outputs, dim=-1) if outputs else x
            assert isinstance(attention, CatformerAttention)
            weights = attention.attention_weights(x)
            maps.append(weights.reshape(*leading, *weights.shape[1:]))
            outputs.append(attention(x))
            outputs.append(ffn(torch.cat(outputs, dim=-1)))
        return maps

    def _steps(self, tokens: Tensor) -> tuple[Tensor, tuple[int, ...]]:
        """[..., K, 1, D] -> [N, K, D] with temporal positions, leading shape."""
        leading = tuple(tokens.shape[:-3])
        x = tokens.reshape(math.prod(leading), tokens.shape[-3], tokens.shape[-1])
        return x + self.positions, leading


class Catformer(HistoryNetwork):
    """Catformer: a ResNet on each frame, then Catformer's layers over the steps.

    Davis et al., "Catformer: Designing Stable Transformers via Sensitivity Analysis", ICML 2021,
    as built for the baseline of arXiv 2212.14538. The weights start as PyTorch's layers do.

    Args:
        observation_shape: (H, W) or (C, H, W), at least 8 pixels a side.
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`CatformerConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not images of that size, or a hyperparameter is not
            possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> network = Catformer(observation_shape=(84, 84), history=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: CatformerConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(CatformerConfig, config, hyperparameters)
        check_image(observation_shape, history, SMALLEST_IMAGE)
        super().__init__(
            observation_shape,
            history,
            frame_encoder=ResNetFrameEncoder(observation_shape, config.embed_dim),
            history_encoder=CatformerEncoder(history, config),
            head=make_head(config.embed_dim, config.features_dim, "relu"),
            features_dim=config.features_dim,
        )
        self.config = config
