"""Vanilla_TIT and Enhanced_TIT, the two backbones of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from torchrl_tit.networks.config import override_config
from torchrl_tit.networks.history_network import HistoryNetwork, check_observation, make_head
from torchrl_tit.networks.initialization import init_normal_
from torchrl_tit.networks.inner import InnerTransformer, LinearFrameEncoder
from torchrl_tit.networks.tit_config import EnhancedTITConfig, VanillaTITConfig


class VanillaTIT(HistoryNetwork):
    """Vanilla_TIT: L inner blocks on each observation, then L outer blocks on the history.

    arXiv 2212.14538, section "Vanilla_TIT", figure 1. The weights start as in the authors' code
    (:func:`~torchrl_tit.networks.init_normal_`).

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`VanillaTITConfig` that override those of ``config``.

    Raises:
        ValueError: if a hyperparameter is not possible; the message names it.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> import torch
        >>> tit = VanillaTIT(observation_shape=(4,), history=8, embed_dim=64, num_heads_outer=4)
        >>> tit(torch.randn(16, 8, 4)).shape
        torch.Size([16, 64])
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: VanillaTITConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(VanillaTITConfig, config, hyperparameters)
        check_observation(observation_shape, history)
        super().__init__(
            observation_shape,
            history,
            frame_encoder=config.make_inner(observation_shape, every_block=False),
            history_encoder=config.make_stacked_outer(history, dense=False),
            head=make_head(config.embed_dim, config.features_dim, config.activation_head),
            features_dim=config.features_dim,
        )
        self.config = config
        init_normal_(self)


class EnhancedTIT(HistoryNetwork):
    """Enhanced_TIT: an outer block beside every inner block, all outer outputs concatenated.

    arXiv 2212.14538, section "Enhanced_TIT", figure 2. The weights start as in the authors' code
    (:func:`~torchrl_tit.networks.init_normal_`).

    The paper's ablations are the hyperparameters ``dense``, ``inner`` and ``outer``:

    - ``dense=False`` reads the last outer block only.
    - ``inner=False`` puts outer blocks, each on the one before, on a linear embedding.
    - ``outer=False`` stacks the K observations as channels and has inner blocks only.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`EnhancedTITConfig` that override those of ``config``.

    Raises:
        ValueError: if a hyperparameter is not possible; the message names it.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> import torch
        >>> tit = EnhancedTIT(observation_shape=(84, 84), history=4, patch_size=12, embed_dim=64)
        >>> tit(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 64])
        >>> [weights.shape[-1] for weights in tit.attention_maps(torch.rand(2, 4, 84, 84)).inner]
        [50, 50]
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: EnhancedTITConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(EnhancedTITConfig, config, hyperparameters)
        check_observation(observation_shape, history)
        frame_encoder: nn.Module | None
        history_encoder: nn.Module
        if not config.outer:
            frame_encoder = None
            history_encoder = StackedFramesTransformer(
                config.make_inner(observation_shape, every_block=config.dense, frames=history)
            )
        elif not config.inner:
            frame_encoder = LinearFrameEncoder(observation_shape, config.embed_dim)
            history_encoder = config.make_stacked_outer(history, dense=config.dense)
        else:
            frame_encoder = config.make_inner(observation_shape, every_block=config.dense)
            history_encoder = config.make_paired_outer(history)
        width = config.embed_dim * (config.num_blocks if config.dense else 1)
        super().__init__(
            observation_shape,
            history,
            frame_encoder=frame_encoder,
            history_encoder=history_encoder,
            head=make_head(width, config.features_dim, config.activation_head),
            features_dim=config.features_dim,
        )
        self.config = config
        init_normal_(self)


class StackedFramesTransformer(nn.Module):
    """Inner blocks over K observations that are stacked as channels: the ablation "w/o Outer".

    Args:
        inner: inner transformer with ``frames=K``.
    """

    def __init__(self, inner: InnerTransformer) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, history: Tensor) -> Tensor:
        """[..., K, *observation_shape] -> class tokens of the blocks, float [..., L * D]."""
        return self.inner(history).flatten(-2)

    def attention_maps(self, history: Tensor) -> list[Tensor]:
        """Returns the attention weights of each block, L x float [..., heads, S, S]."""
        return self.inner.attention_maps(history)
