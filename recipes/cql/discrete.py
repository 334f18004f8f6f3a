"""Conservative Q-learning, discrete actions: the settings, and the step that they drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_tit.objectives import DelayedDiscreteCQLLoss

from ..compilation import compile_and_time
from ..finite import check_finite
from ..recipe import check_at_least
from .agent import DiscreteCQLAgent, parameters_of
from .recipe import CQLRecipe


@dataclass(frozen=True, kw_only=True)
class DiscreteCQL(CQLRecipe[DiscreteCQLAgent]):
    """Conservative Q-learning (arXiv 2006.04779) with a value for each action, on TorchRL's loss.

    The squared error is halved, as in TorchRL. The paper ran no discrete task offline.
    """

    algorithm: ClassVar[str] = "discrete-cql"
    continuous: ClassVar[bool] = False

    conservative_weight: float = 1.0
    """Weight of the conservative term."""
    learning_rate: float = 3e-4
    """Learning rate of Adam."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, learning_rate=0)

    def make_agent(self) -> DiscreteCQLAgent:
        """Builds the Q network, untrained."""
        return DiscreteCQLAgent(self)

    def make_update(
        self, agent: DiscreteCQLAgent
    ) -> tuple[DiscreteCQLUpdate, dict[str, torch.optim.Optimizer]]:
        """Builds the gradient step of an agent, and its optimizer."""
        optimizer = torch.optim.Adam(
            parameters_of(agent.loss.value_network_params),
            lr=self.learning_rate,
            eps=self.adam_eps,
            fused=True,
        )
        update = DiscreteCQLUpdate(
            agent.loss,
            optimizer,
            SoftUpdate(agent.loss, tau=self.tau),
            conservative_weight=self.conservative_weight,
            options=self.compile_options(),
        )
        return update, {"optimizer": optimizer}


class DiscreteCQLUpdate:
    """Steps the Q network and moves its target, on one batch.

    Args:
        loss: the losses, with all weights.
        optimizer: of the Q network.
        target: moves the target network.
        conservative_weight: weight of the conservative term.
        options: of ``torch.compile``; without any nothing is compiled.
    """

    TERMS: ClassVar[list[str]] = ["loss_qvalue", "loss_cql", "value"]
    """What a gradient step gives."""

    def __init__(
        self,
        loss: DelayedDiscreteCQLLoss,
        optimizer: torch.optim.Optimizer,
        target: SoftUpdate,
        *,
        conservative_weight: float,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.optimizer = optimizer
        self.target = target
        self.conservative_weight = conservative_weight
        self.objective = loss.forward
        if options is not None:
            self.objective = compile_and_time(loss.forward, options, "the loss")

    def __call__(self, batch: TensorDictBase, step: int, saved_step: int) -> Tensor:
        """Takes a step.

        Args:
            batch: transitions [B].
            step: gradient steps before this one, for messages.
            saved_step: step of the newest checkpoint, for messages.

        Returns:
            ``TERMS``, float [terms].

        Raises:
            FloatingPointError: if a term is not finite.
        """
        losses = self.objective(batch)
        total = losses["loss_qvalue"] + self.conservative_weight * losses["loss_cql"]
        terms = torch.stack([losses[n].detach() for n in ("loss_qvalue", "loss_cql", "pred_value")])
        check_finite(self.TERMS, terms, step, saved_step)
        self.optimizer.zero_grad()
        total.backward()
        self.optimizer.step()
        self.target.step()
        return terms
