"""The one idea of this library: a frame encoder, then a history encoder, then a head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_tit.networks.activations import Activation, make_activation


@dataclass(frozen=True)
class AttentionMaps:
    """Attention weights of every block, rows (queries) summing to 1.

    Attributes:
        inner: of each inner block, float [..., K, heads, S, S] with S = 1 + patches and the class
            token at position 0 (without K where frames are stacked as channels).
        outer: of each outer block, float [..., heads, K, K], lower triangular.
    """

    inner: list[Tensor]
    outer: list[Tensor]


class HistoryNetwork(nn.Module):
    """Maps a history of K observations to features: frame encoder, history encoder, head.

        history  [..., K, *observation_shape]
          frame encoder    -> tokens   [..., K, L, D]   one observation at a time, shared over time
          history encoder  -> outputs  [..., E]         what happened over the K steps
          head             -> features [..., F]

    Nothing flows from the history encoder back into the frame encoder, so the tokens of a frame
    depend on that frame alone (arXiv 2212.14538, appendix on information flow: "T-S" is 0).

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        history: number of observations K >= 1.
        frame_encoder: [..., *observation_shape] -> [..., L, D]; None where the history encoder
            reads the observations themselves.
        history_encoder: [..., K, L, D] -> [..., E].
        head: [..., E] -> [..., F].
        features_dim: size F of the features.

    Raises:
        ValueError: if ``history`` or ``observation_shape`` are not possible, or a history of
            another shape is given to ``forward``.
        TypeError: if a history of another dtype is given to ``forward``.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int,
        *,
        frame_encoder: nn.Module | None,
        history_encoder: nn.Module,
        head: nn.Module,
        features_dim: int,
    ) -> None:
        super().__init__()
        self.observation_shape = tuple(observation_shape)
        self.history = history
        self.features_dim = features_dim
        self.frame_encoder = frame_encoder
        self.history_encoder = history_encoder
        self.head = head

    def forward(self, history: Tensor) -> Tensor:
        """Maps histories to features.

        Args:
            history: [..., K, *observation_shape], oldest first; uint8 (divided by 255) or of the
                network's own float type (taken as it is).

        Returns:
            float [..., F].
        """
        self.check(history)
        tokens = history if self.frame_encoder is None else self.frame_encoder(history)
        return self.encode_history(tokens)

    def encode_history(self, tokens: Tensor) -> Tensor:
        """Maps the tokens of K observations to features, float [..., K, L, D] -> [..., F]."""
        return self.head(self.history_encoder(tokens))

    def attention_maps(self, history: Tensor) -> AttentionMaps:
        """Returns the attention weights of every inner and outer block.

        A pass of its own: the usual one computes neither these nor what is not read.

        Args:
            history: as in ``forward``.
        """
        self.check(history)
        if self.frame_encoder is None:
            return AttentionMaps(_attention_maps(self.history_encoder, history), [])
        return AttentionMaps(
            _attention_maps(self.frame_encoder, history),
            _attention_maps(self.history_encoder, self.frame_encoder(history)),
        )

    def check(self, history: Tensor) -> None:
        """Raises ValueError or TypeError where a history does not fit this network."""
        check_history(history, self.history, self.observation_shape, weights_dtype(self))


def _attention_maps(encoder: nn.Module, x: Tensor) -> list[Tensor]:
    """Returns an encoder's attention weights: none where it has no attention."""
    attention_maps = getattr(encoder, "attention_maps", None)
    return [] if attention_maps is None else attention_maps(x)


def weights_dtype(network: nn.Module) -> torch.dtype:
    """Returns the float type of a network's weights.

    Not that of ``parameters()``, which is empty where TorchRL's losses have put plain tensors
    (target weights, a stack of critics) in their places.
    """
    weights = (getattr(module, "weight", None) for module in network.modules())
    return next(weight.dtype for weight in weights if isinstance(weight, Tensor))


def check_history(
    history: Tensor, steps: int, observation_shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    """Raises ValueError or TypeError where a history does not fit a network.

    Args:
        history: what the network is given.
        steps: number of observations K that it reads.
        observation_shape: shape of one of them.
        dtype: type of the network's weights.
    """
    expected = (steps, *observation_shape)
    if tuple(history.shape[-len(expected) :]) != expected:
        raise ValueError(
            f"a history of shape {tuple(history.shape)} does not fit this network: expected "
            f"[..., {', '.join(map(str, expected))}], which is {steps} observations of "
            f"shape {observation_shape}, oldest first (torchrl_tit.History stacks them)"
        )
    device = history.device.type
    # "meta", say, has no autocast to ask about.
    autocast = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    # Autocast converts every float type but double.
    fits = history.dtype == dtype or (
        autocast and history.is_floating_point() and history.dtype != torch.float64
    )
    if not fits and history.dtype != torch.uint8:
        raise TypeError(
            f"a history of {history.dtype} does not fit this network of {dtype}: give it "
            "uint8, or convert it first (TorchRL's DoubleToFloat, say)"
        )


def check_observation(observation_shape: Sequence[int], history: int) -> None:
    """Raises ValueError where no network can read such observations or histories."""
    if history < 1:
        raise ValueError(f"history is the number of observations K and must be >= 1, not {history}")
    if len(observation_shape) not in (1, 2, 3) or min(observation_shape) < 1:
        raise ValueError(
            f"observation_shape {tuple(observation_shape)} is not that of an array (D,) or an "
            "image (H, W) or (C, H, W)"
        )


def make_head(in_features: int, features_dim: int, activation: Activation) -> nn.Sequential:
    """The head after the backbone: LayerNorm, linear, activation, LayerNorm.

    Args:
        in_features: size E of the history encoder's output.
        features_dim: size F of the features.
        activation: activation by name.

    Example:
        >>> make_head(64, 32, "tanh")(torch.randn(8, 64)).shape
        torch.Size([8, 32])
    """
    return nn.Sequential(
        nn.LayerNorm(in_features),
        nn.Linear(in_features, features_dim),
        make_activation(activation),
        nn.LayerNorm(features_dim),
    )
