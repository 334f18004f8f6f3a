"""Conservative Q-learning, discrete actions: the settings, and the step that they drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torchrl.objectives import SoftUpdate

from .compilation import compile_and_time
from .cql_agent import DiscreteCQLAgent, parameters_of
from .cql_recipe import CQLRecipe
from .offline_state import TrainingState
from .offline_training import run_updates
from .ppo_update import check_finite
from .recipe import check_at_least
from .run import Run

TERMS = ["loss_qvalue", "loss_cql", "value"]


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

    def train(self, run: Run) -> None:
        """Trains in a run folder; see :func:`train`."""
        train(self, run)


def train(recipe: DiscreteCQL, run: Run) -> None:
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
    optimizer = torch.optim.Adam(
        parameters_of(agent.loss.value_network_params),
        lr=recipe.learning_rate,
        eps=recipe.adam_eps,
        fused=True,
    )
    target = SoftUpdate(agent.loss, tau=recipe.tau)
    state = TrainingState(
        {"agent": agent, "optimizer": optimizer, "buffer": buffer}, recipe.evaluation_seed
    )
    objective = agent.loss.forward
    options = recipe.compile_options()
    if options is not None:
        objective = compile_and_time(objective, options, "the loss")

    def update(step: int) -> Tensor:
        losses = objective(buffer.sample())
        total = losses["loss_qvalue"] + recipe.conservative_weight * losses["loss_cql"]
        terms = torch.stack([losses[n].detach() for n in ("loss_qvalue", "loss_cql", "pred_value")])
        check_finite(TERMS, terms, step, state.saved_step)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        target.step()
        return terms

    run_updates(recipe, run, agent, state, TERMS, update)
