"""Self-supervised losses on a backbone's features: the next frame's tokens, and the frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_tit.frames import FrameEncoder
from torchrl_tit.layers.images import bytes_to_floats


class NextFrameLoss(nn.Module):
    r"""Predicts the tokens of the next observation from the features and the action.

    A token's loss is one minus the cosine of prediction and target, as in SPR (Schwarzer et al.,
    arXiv 2007.05929) with one step and without augmentation. The targets come from a slowly moving
    copy of the frame encoders, :math:`\bar\theta \leftarrow d\,\bar\theta + (1 - d)\,\theta`: with
    the encoders themselves, identical tokens would be a trivial solution. The TIT paper names such
    losses as future work (arXiv 2212.14538, appendix).

    Args:
        frames: the frame encoder of each observation; their tokens have one width.
        features_dim: size F of the features.
        action_dim: entries A of an action; categories are one-hot.
        hidden_dim: width of the predictor's hidden layer.
        decay: fraction d of the copy's weights that :meth:`update_target` keeps.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> tit = EnhancedTIT((4,), num_frames=8)
        >>> loss = NextFrameLoss(tit.frames, tit.features_dim, action_dim=2)
        >>> features, actions = torch.randn(3, 16, 64), torch.randn(3, 16, 2)
        >>> is_init = torch.zeros(3, 16, dtype=torch.bool)
        >>> loss(features, actions, [torch.randn(3, 16, 4)], is_init).shape
        torch.Size([])
    """

    def __init__(
        self,
        frames: Sequence[FrameEncoder],
        features_dim: int,
        action_dim: int,
        *,
        hidden_dim: int = 256,
        decay: float = 0.99,
    ) -> None:
        super().__init__()
        self.decay = decay
        self.target = deepcopy(nn.ModuleList(frames)).requires_grad_(False)
        tokens = sum(encoder.num_tokens for encoder in frames)
        self.predictor = _mlp(features_dim + action_dim, hidden_dim, tokens * frames[0].width)

    def forward(
        self, features: Tensor, actions: Tensor, observations: Sequence[Tensor], is_init: Tensor
    ) -> Tensor:
        """Compares predictions with the next step's tokens, within episodes only.

        Args:
            features: float [N, T, F].
            actions: float [N, T, A].
            observations: one tensor per frame encoder, [N, T, *observation_shape].
            is_init: bool [N, T], True where an episode begins.

        Returns:
            The mean over tokens and steps, float [], from 0 to 2; 0 if no step has a next one.
        """
        predicted = self.predictor(torch.cat([features, actions], -1)[:, :-1])
        with torch.no_grad():
            tokens = torch.cat(
                [
                    encoder(observation[:, 1:])
                    for encoder, observation in zip(self.target, observations, strict=True)
                ],
                dim=-2,
            )  # [N, T - 1, L, D]
        cosine = F.cosine_similarity(predicted.view_as(tokens), tokens, dim=-1).mean(-1)
        follows = ~is_init[:, 1:]
        return torch.where(follows, 1 - cosine, 0).sum() / follows.sum().clamp(min=1)

    @torch.no_grad()
    def update_target(self, frames: Sequence[FrameEncoder]) -> None:
        """Moves the copy towards the frame encoders, after each gradient step."""
        encoders = nn.ModuleList(frames)
        for copy, new in zip(self.target.parameters(), encoders.parameters(), strict=True):
            copy.lerp_(new, 1 - self.decay)
        for buffer, current in zip(self.target.buffers(), encoders.buffers(), strict=True):
            buffer.copy_(current)


class ReconstructionLoss(nn.Module):
    """Reconstructs the current observation from the features.

    Autoencoders of observations in RL: Lange and Riedmiller, IJCNN 2010; Yarats et al., arXiv
    1910.01741.

    Args:
        observation_shapes: shape of each observation, an array or an image.
        features_dim: size F of the features.
        hidden_dim: width of the decoder's hidden layer.

    Example:
        >>> loss = ReconstructionLoss([(3, 24, 24)], features_dim=64)
        >>> frames = torch.randint(0, 256, (8, 16, 3, 24, 24), dtype=torch.uint8)
        >>> loss(torch.randn(8, 16, 64), [frames]).shape
        torch.Size([])
    """

    def __init__(
        self,
        observation_shapes: Sequence[Sequence[int]],
        features_dim: int,
        *,
        hidden_dim: int = 256,
    ) -> None:
        super().__init__()
        sizes = [math.prod(shape) for shape in observation_shapes]
        self.decoders = nn.ModuleList(_mlp(features_dim, hidden_dim, size) for size in sizes)

    def forward(self, features: Tensor, observations: Sequence[Tensor]) -> Tensor:
        """Compares reconstructions with observations.

        Args:
            features: float [*B, F].
            observations: [*B, *observation_shape] each; floats, or uint8, which is scaled to 0..1.

        Returns:
            The sum over observations of the mean squared error, float [].
        """
        total = features.new_zeros(())
        for decoder, observation in zip(self.decoders, observations, strict=True):
            wanted = bytes_to_floats(observation, features.dtype).flatten(features.ndim - 1)
            total = total + F.mse_loss(decoder(features), wanted.to(features.dtype))
        return total


def _mlp(in_features: int, hidden_features: int, out_features: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(in_features, hidden_features),
        nn.ReLU(),
        nn.Linear(hidden_features, out_features),
    )
