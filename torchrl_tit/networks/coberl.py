"""CoBERL: ResNet, gated transformer, gate and LSTM, with a hook for its contrastive loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import LSTM

from torchrl_tit.networks.config import check_positive, override_config
from torchrl_tit.networks.gated_transformer import GatedTransformerBlock, GRUGate
from torchrl_tit.networks.history_network import HistoryNetwork
from torchrl_tit.networks.images import check_image
from torchrl_tit.networks.resnet import SMALLEST_IMAGE, ResNetFrameEncoder


@dataclass(frozen=True, kw_only=True)
class CoBERLConfig:
    """Hyperparameters of CoBERL.

    Widths are those of GTrXL (arXiv 1910.06764, appendix), with fewer blocks for short histories.
    """

    embed_dim: int = 256
    """Width D of a token."""
    num_blocks: int = 2
    """Number of gated transformer blocks."""
    num_heads: int = 8
    """Attention heads; must divide the width."""
    ffn_expansion: int = 4
    """Hidden width of an FFN as a multiple of the width."""
    gate_bias: float = 0.0
    """Start value of the bias of all gates; 2 starts them near the identity, as its paper does."""
    features_dim: int = 512
    """Size of the LSTM's state, which is the features that the network puts out."""

    def __post_init__(self) -> None:
        check_positive(self, "embed_dim", "num_blocks", "ffn_expansion", "features_dim")


class CoBERLEncoder(nn.Module):
    """Gated transformer over the tokens of K steps, a gate that mixes its input in, an LSTM.

    The gate lets the LSTM read the tokens themselves until the transformer is worth reading. The
    LSTM starts at zero with the history.

    Args:
        history: number of steps K.
        config: hyperparameters.

    Example:
        >>> encoder = CoBERLEncoder(4, CoBERLConfig(embed_dim=32, features_dim=64))
        >>> encoder(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 64])
    """

    def __init__(self, history: int, config: CoBERLConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            GatedTransformerBlock(
                config.embed_dim,
                config.num_heads,
                history,
                ffn_expansion=config.ffn_expansion,
                gate_bias=config.gate_bias,
            )
            for _ in range(config.num_blocks)
        )
        self.mask_token = nn.Parameter(torch.empty(config.embed_dim))
        self.gate = GRUGate(config.embed_dim, config.gate_bias)
        # TorchRL's LSTM, not PyTorch's: it works under vmap and in a compiled graph.
        self.lstm = LSTM(config.embed_dim, config.features_dim, batch_first=True)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises the mask token: normal with a standard deviation of 0.02."""
        nn.init.normal_(self.mask_token, std=0.02)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K steps, float [..., K, 1, D] -> state of the LSTM, float [..., F]."""
        x, leading = self._steps(tokens)  # [N, K, D]
        states, _ = self.lstm(self.gate(x, self._transform(x, causal=True)))  # [N, K, F]
        return states[:, -1].reshape(*leading, states.shape[-1])

    def predict_masked(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """Predicts every step from both sides, with the masked ones hidden.

        Args:
            tokens: float [..., K, 1, D].
            mask: bool [..., K], True where a step is hidden.

        Returns:
            float [..., K, D].
        """
        hidden = torch.where(mask[..., None, None], self.mask_token.to(tokens.dtype), tokens)
        x, leading = self._steps(hidden)
        return self._transform(x, causal=False).reshape(*leading, *x.shape[1:])

    def attention_maps(self, tokens: Tensor) -> list[Tensor]:
        """Returns the attention weights of each block, float [..., heads, K, K]."""
        x, leading = self._steps(tokens)
        maps = []
        for block in self.blocks:
            assert isinstance(block, GatedTransformerBlock)
            weights = block.attention_weights(x)
            maps.append(weights.reshape(*leading, *weights.shape[1:]))
            x = block(x, causal=True)
        return maps

    def _steps(self, tokens: Tensor) -> tuple[Tensor, tuple[int, ...]]:
        """[..., K, 1, D] -> [N, K, D], leading shape."""
        leading = tuple(tokens.shape[:-3])
        return tokens.reshape(math.prod(leading), tokens.shape[-3], tokens.shape[-1]), leading

    def _transform(self, x: Tensor, *, causal: bool) -> Tensor:
        for block in self.blocks:
            x = block(x, causal=causal)
        return x


class CoBERL(HistoryNetwork):
    """CoBERL: a ResNet on each frame, a gated transformer over the steps, a gate and an LSTM.

    Banino et al., "CoBERL: Contrastive BERT for Reinforcement Learning", arXiv 2107.05431, figure
    1; a baseline of arXiv 2212.14538. Its contrastive loss reads :meth:`predict_masked`. The
    weights start as PyTorch's layers do.

    Args:
        observation_shape: (H, W) or (C, H, W), at least 8 pixels a side.
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`CoBERLConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not images of that size, or a hyperparameter is not
            possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> network = CoBERL(observation_shape=(84, 84), history=4)
        >>> history = torch.zeros(2, 4, 84, 84, dtype=torch.uint8)
        >>> network(history).shape
        torch.Size([2, 512])
        >>> encodings, predictions = network.predict_masked(history, torch.rand(2, 4) < 0.15)
        >>> encodings.shape, predictions.shape
        (torch.Size([2, 4, 256]), torch.Size([2, 4, 256]))
    """

    frame_encoder: ResNetFrameEncoder
    history_encoder: CoBERLEncoder

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: CoBERLConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(CoBERLConfig, config, hyperparameters)
        check_image(observation_shape, history, SMALLEST_IMAGE)
        super().__init__(
            observation_shape,
            history,
            frame_encoder=ResNetFrameEncoder(observation_shape, config.embed_dim),
            history_encoder=CoBERLEncoder(history, config),
            head=nn.Identity(),
            features_dim=config.features_dim,
        )
        self.config = config

    def predict_masked(self, history: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Encodes every step, and predicts it from the others with the masked ones hidden.

        What the contrastive loss compares at the masked steps (arXiv 2107.05431, section 2.1): the
        transformer sees past and future there, and neither gate nor LSTM take part.

        Args:
            history: as in ``forward``.
            mask: bool [..., K], True where a step is hidden (15% of them in the paper).

        Returns:
            The encodings and their predictions, float [..., K, D] each.
        """
        self.check(history)
        tokens = self.frame_encoder(history)  # [..., K, 1, D]
        return tokens[..., 0, :], self.history_encoder.predict_masked(tokens, mask)
