"""PPO with the contrastive loss of CoBERL, which learns to predict masked frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase

from torchrl_tit.networks import masked_predictions
from torchrl_tit.objectives import contrastive_prediction_loss
from torchrl_tit.settings import CoBERL
from torchrl_tit.settings.numbers import Weight
from torchrl_tit.windows import Windows

from .ppo import PPO, Minibatch, PPOAlgorithm

_MASKED = 0.15  # the share of the frames that are masked, of arXiv 2107.05431


@dataclass(frozen=True, kw_only=True)
class ContrastivePPO(PPO, algorithm="ppo-coberl"):
    """PPO with CoBERL's contrastive loss (arXiv 2107.05431), for networks with its encoder."""

    removed: ClassVar[dict[str, Any]] = {
        name: value for name, value in PPO.removed.items() if name != "contrastive_coeff"
    }

    contrastive_coeff: Weight = 1.0
    """Weight of the contrastive loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.backbone.history, CoBERL):
            raise ValueError(
                f"the contrastive loss of ppo-coberl compares what only coberl predicts, not "
                f"{self.backbone.history.name}: take a ppo recipe for other history encoders"
            )

    def build(self) -> ContrastivePPOAlgorithm:
        """Builds the algorithm."""
        return ContrastivePPOAlgorithm(self)


class ContrastivePPOAlgorithm(PPOAlgorithm):
    """PPO with CoBERL's contrastive loss.

    Args:
        recipe: the settings.
    """

    recipe: ContrastivePPO
    terms = (*PPOAlgorithm.terms, "loss_contrastive")

    def loss(self, minibatch: Minibatch) -> TensorDictBase:
        """Adds the contrastive loss, of a pass of its own, because its attention is not causal.

        It reads windows that do not overlap (unless sequences are shorter than a window), because
        otherwise a frame would be contrasted with its own copies.
        """
        terms, (_, frames, (rows, missing, _)) = super().loss(minibatch), minibatch
        length = min(rows.shape[-2:])
        apart = slice(length - 1, None, length)
        windows = Windows(rows[:, apart], None if missing is None else missing[:, apart])
        histories = [windows.gather(table).flatten(0, 1) for table in frames]
        padding = windows.padded().flatten(0, 1)
        mask = (torch.rand(padding.shape, device=padding.device) < _MASKED) & ~padding
        predictions = masked_predictions(self.model.backbone.module, histories, mask)
        contrast = contrastive_prediction_loss(*predictions, mask, padding)
        terms["loss_contrastive"] = self.recipe.contrastive_coeff * contrast
        return terms
