"""The self-supervised losses of a recipe, in addition to PPO's own."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Categorical, MultiCategorical, TensorSpec

from torchrl_tit.frames.normalized import NormalizedFrames
from torchrl_tit.layers.categories import CategoryIndex
from torchrl_tit.modules import Backbone
from torchrl_tit.modules.backbone import trunks_of
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.objectives import NextFrameLoss, ReconstructionLoss

from .settings import PPO


class AuxiliaryLosses(nn.Module):
    """The losses that ``next_frame_coeff`` and ``reconstruction_coeff`` add.

    They train the policy's trunk, if there are two. Without these settings it has no parameters.

    Args:
        recipe: the settings.
        backbone: reads the observations.
        action_spec: spec of one action.

    Raises:
        ValueError: if categories are to be reconstructed.
    """

    def __init__(self, recipe: PPO, backbone: Backbone, action_spec: TensorSpec) -> None:
        super().__init__()
        self.weights: dict[str, float] = {}
        """The weight of each loss."""
        trunk, features_dim = _trunk(backbone), backbone.features_dim
        if recipe.next_frame_coeff:
            self.weights["loss_next_frame"] = recipe.next_frame_coeff
            self.actions = ActionEntries(action_spec)
            self.next_frame = NextFrameLoss(trunk.frames, features_dim, self.actions.size)
        if recipe.reconstruction_coeff:
            self.weights["loss_reconstruction"] = recipe.reconstruction_coeff
            for name, observation in trunk.observations.items():
                if observation.categories is not None:
                    raise ValueError(
                        f"reconstruction_coeff is {recipe.reconstruction_coeff:g}, but {name!r} is "
                        f"{observation}: only arrays and images are reconstructed"
                    )
            shapes = [observation.shape for observation in trunk.observations.values()]
            self.reconstruction = ReconstructionLoss(shapes, features_dim)

    def forward(self, sequences: TensorDictBase, backbone: Backbone) -> tuple[Tensor, list[Tensor]]:
        """Computes the losses of sequences [N, T] for which the backbone wrote features.

        Returns:
            The weighted sum, float [], and each loss in the order of ``weights``, float [].
        """
        features = sequences[backbone.features_keys[0]]
        if backbone.is_recurrent:  # it reads histories of one frame
            observations = [sequences[key][:, :, 0] for key in backbone.history_keys]
        else:
            observations = [sequences[key] for key in backbone.sequence_keys.observations]
        losses = []
        if "loss_next_frame" in self.weights:
            actions = self.actions(sequences["action"])
            is_init = sequences["is_init"].squeeze(-1)
            losses.append(self.next_frame(features, actions, observations, is_init))
        if "loss_reconstruction" in self.weights:
            pairs = zip(_trunk(backbone).frames, observations, strict=True)
            wanted = [
                encoder.normalize(observation)
                if isinstance(encoder, NormalizedFrames)
                else observation
                for encoder, observation in pairs
            ]
            losses.append(self.reconstruction(features, wanted))
        weighted = [x * weight for x, weight in zip(losses, self.weights.values(), strict=True)]
        return torch.stack(weighted).sum(), [loss.detach() for loss in losses]

    def update_targets(self, backbone: Backbone) -> None:
        """Moves the prediction targets towards the frame encoders, after a gradient step."""
        if "loss_next_frame" in self.weights:
            self.next_frame.update_target(_trunk(backbone).frames)


def _trunk(backbone: Backbone) -> HistoryNetwork:
    return next(iter(trunks_of(backbone.module).values()))


class ActionEntries(nn.Module):
    """Actions as rows of floats; categories are one-hot.

    Args:
        spec: spec of one action.

    Example:
        >>> entries = ActionEntries(Categorical(3))
        >>> entries(torch.tensor([0, 2]))
        tensor([[1., 0., 0.],
                [0., 0., 1.]])
    """

    def __init__(self, spec: TensorSpec) -> None:
        super().__init__()
        counts: list[int] | None = None
        if isinstance(spec, MultiCategorical):
            counts = spec.nvec.tolist()
        elif isinstance(spec, Categorical) and not isinstance(spec, Binary):  # its subclass
            counts = [int(spec.space.n)]
        self.index = None if counts is None else CategoryIndex(counts)
        self.ndim = spec.ndim
        self.size = spec.shape.numel() if counts is None else sum(counts)
        """Number of entries."""

    def forward(self, actions: Tensor) -> Tensor:
        """Actions [*B, *action_shape] -> float [*B, size]."""
        rows = actions.unsqueeze(-1) if self.ndim == 0 else actions.flatten(-self.ndim)
        if self.index is not None:
            rows = self.index.one_hot(rows)
        return rows.to(torch.get_default_dtype())
