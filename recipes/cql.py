"""Conservative Q-learning, continuous actions: the settings, and the step that they drive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_tit.objectives.cql import OverCritics

from .cql_agent import CQLAgent, parameters_of
from .cql_recipe import CQLRecipe
from .cql_update import CQLUpdate
from .offline_state import TrainingState
from .offline_training import run_updates
from .recipe import check_at_least
from .run import Run

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
        if self.critic not in ("mlp", "backbone"):
            raise ValueError(f"critic must be 'mlp' or 'backbone', not {self.critic!r}")
        if not self.temperature_init > 0:
            raise ValueError(f"temperature_init must be positive, not {self.temperature_init}")
        if not self.critic_hidden or min(self.critic_hidden) < 1:
            raise ValueError(
                f"critic_hidden must be at least one width of at least 1, not {self.critic_hidden}"
            )

    def make_agent(self) -> CQLAgent:
        """Builds actor and critics, untrained."""
        return CQLAgent(self)

    def train(self, run: Run) -> None:
        """Trains in a run folder; see :func:`train`."""
        train(self, run)


def train(recipe: CQL, run: Run) -> None:
    """Trains an agent, from the newest checkpoint of the run where there is one.

    Args:
        recipe: the settings.
        run: an open run folder.

    Raises:
        FloatingPointError: if a loss is not finite.
    """
    torch.set_num_threads(recipe.threads)
    torch.manual_seed(recipe.seed)
    buffer = recipe.make_buffer()
    agent = recipe.make_agent()
    update, optimizers = make_update(recipe, agent)
    state = TrainingState({"agent": agent, **optimizers, "buffer": buffer}, recipe.evaluation_seed)

    def step(number: int) -> Tensor:
        return update(buffer.sample(), number, state.saved_step)

    run_updates(recipe, run, agent, state, CQLUpdate.TERMS, step)


def make_update(recipe: CQL, agent: CQLAgent) -> tuple[CQLUpdate, dict[str, torch.optim.Optimizer]]:
    """Builds the gradient step of an agent.

    Args:
        recipe: the settings.
        agent: what is trained.

    Returns:
        The step, and its optimizers by name.
    """
    loss = agent.loss
    adam = partial(torch.optim.Adam, eps=recipe.adam_eps, fused=True)
    optimizers: dict[str, torch.optim.Optimizer] = {
        "temperature_optimizer": adam([loss.log_alpha], lr=recipe.temperature_learning_rate),
        "critic_optimizer": adam(
            parameters_of(loss.qvalue_network_params), lr=recipe.critic_learning_rate
        ),
        "actor_optimizer": adam(
            parameters_of(loss.actor_network_params), lr=recipe.actor_learning_rate
        ),
    }
    in_cache = max(1, _ACTIONS_IN_CACHE // (3 * recipe.action_samples + 1))
    update = CQLUpdate(
        loss,
        **optimizers,
        target=SoftUpdate(loss, tau=recipe.tau),
        states_at_once=in_cache if recipe.torch_device().type == "cpu" else None,
        options=recipe.compile_options(),
    )
    return update, optimizers
