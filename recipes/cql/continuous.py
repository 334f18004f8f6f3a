"""Conservative Q-learning, continuous actions: the settings, and the step that they drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from torchrl.objectives import SoftUpdate

from torchrl_tit.objectives import ContinuousCQLLoss, StackedCQLLoss
from torchrl_tit.objectives.cql import OverCritics

from ..recipe import check_at_least
from ..run import Run
from .agent import CQLAgent, parameters_of
from .recipe import CQLRecipe
from .seeds import train_seeds
from .update import CQLUpdate

# What critics of three layers of 256 keep of so many actions, 8 MB, fits into a CPU's cache.
_ACTIONS_IN_CACHE = 2000


@dataclass(frozen=True, kw_only=True)
class CQL(CQLRecipe[CQLAgent]):
    """Conservative Q-learning (arXiv 2006.04779) on a data set with continuous actions.

    The defaults are those of d3rlpy 1.1.1, with which arXiv 2212.14538 trained CQL_TIT.
    """

    algorithm: ClassVar[str] = "cql"
    compiling_pays_on: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    continuous: ClassVar[bool] = True
    trains_side_by_side: ClassVar[bool] = True

    actor_learning_rate: float = 1e-4
    """Learning rate of Adam for the actor."""
    critic_learning_rate: float = 3e-4
    """Learning rate of Adam for the critics."""
    temperature_learning_rate: float = 1e-4
    """Learning rate of Adam for the temperature."""
    temperature_init: float = 1.0
    """Weight of the entropy at the start."""
    action_samples: int = 10
    """Actions drawn in each state from each of: uniform, the policy there, the policy at s'."""
    over_critics: OverCritics = "mean"
    """Whether the conservative term is the mean over the two critics, as in d3rlpy 1.1.1, or their
    sum, as in its versions from 2.5 on."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether the critics read the newest observation, or features of a backbone of their own with
    the settings of the actor's."""
    critic_hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the critics' hidden layers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            actor_learning_rate=0,
            critic_learning_rate=0,
            temperature_learning_rate=0,
            action_samples=1,
        )
        if not self.temperature_init > 0:
            raise ValueError(f"temperature_init must be positive, not {self.temperature_init}")
        if not self.critic_hidden or min(self.critic_hidden) < 1:
            raise ValueError(
                f"critic_hidden must be at least one width of at least 1, not {self.critic_hidden}"
            )

    def make_agent(self) -> CQLAgent:
        """Builds actor and critics, untrained."""
        return CQLAgent(self)

    def make_update(self, agent: CQLAgent) -> tuple[CQLUpdate, dict[str, torch.optim.Optimizer]]:
        """Builds the gradient step of an agent, and its optimizers by name."""
        in_cache = max(1, _ACTIONS_IN_CACHE // (3 * self.action_samples + 1))
        return self._make_update(
            agent.loss,
            SoftUpdate(agent.loss, tau=self.tau).step,
            states_at_once=in_cache if self.torch_device().type == "cpu" else None,
        )

    def make_stacked_update(
        self, agents: Sequence[CQLAgent]
    ) -> tuple[CQLUpdate, dict[str, torch.optim.Optimizer]]:
        """Builds one gradient step of several agents, and the optimizers by name."""
        loss = StackedCQLLoss([agent.loss for agent in agents])
        return self._make_update(loss, partial(loss.update_targets, self.tau))

    def train_side_by_side(self, runs: Sequence[Run]) -> None:
        """Trains runs of several seeds; see :func:`~recipes.cql.seeds.train_seeds`."""
        train_seeds(self, runs)

    def _make_update(
        self,
        loss: ContinuousCQLLoss | StackedCQLLoss,
        update_targets: Callable[[], None],
        states_at_once: int | None = None,
    ) -> tuple[CQLUpdate, dict[str, torch.optim.Optimizer]]:
        adam = partial(torch.optim.Adam, eps=self.adam_eps, fused=True)
        critics, actor = map(parameters_of, (loss.qvalue_network_params, loss.actor_network_params))
        optimizers: dict[str, torch.optim.Optimizer] = {
            "temperature_optimizer": adam([loss.log_alpha], lr=self.temperature_learning_rate),
            "critic_optimizer": adam(critics, lr=self.critic_learning_rate),
            "actor_optimizer": adam(actor, lr=self.actor_learning_rate),
        }
        update = CQLUpdate(
            loss,
            **optimizers,
            update_targets=update_targets,
            states_at_once=states_at_once,
            options=self.compile_options(),
        )
        return update, optimizers
