"""Decision Transformer, offline."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from torchrl_tit.datasets import make_replay_buffer
from torchrl_tit.modules import make_dt_predictor
from torchrl_tit.objectives import MaskedDTLoss

from ..algorithm import Stateful, check_finite
from .sequence_algorithm import SequenceAlgorithm
from .settings import DT


class DTAlgorithm(SequenceAlgorithm[DT]):
    """Decision Transformer: AdamW on the error of the predicted actions.

    Args:
        recipe: the settings.
    """

    columns = ("loss", "gradient_norm", "learning_rate")

    def prepare(self, step: int, folder: Path) -> None:
        """Builds replay buffer, loss and optimizer."""
        recipe, agent = self.recipe, self.agent.train()
        self.buffer = self.make_buffer()
        self.loss = MaskedDTLoss(
            make_dt_predictor(agent.network, agent.head),
            loss_function="cross_entropy" if recipe.action_space == "discrete" else "l2",
        )
        self.optimizer = torch.optim.AdamW(
            agent.parameters(),
            lr=recipe.learning_rate,
            weight_decay=recipe.weight_decay,
            fused=True,
        )

    def make_buffer(self) -> ReplayBuffer:
        """Reads the data set into a replay buffer of windows."""
        storage = self.make_storage(self.load_data())
        return make_replay_buffer(storage, self.recipe.batch_size, seed=self.recipe.seed)

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, and the sampling state of the replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer}

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor | float]:
        """Takes a gradient step on windows [B]."""
        learning_rate = self.recipe.learning_rate_at(step)
        self.optimizer.param_groups[0]["lr"] = learning_rate
        loss = self.loss(batch)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.agent.parameters(), self.recipe.max_grad_norm)
        check_finite(self.columns[:2], torch.stack([loss.detach(), norm]))
        self.optimizer.step()
        return {"loss": loss.detach(), "gradient_norm": norm, "learning_rate": learning_rate}
