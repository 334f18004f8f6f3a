"""Decision Transformer, offline: the settings, and the gradient step that they drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from torchrl_tit.datasets import SequenceStorage, make_replay_buffer
from torchrl_tit.modules import make_dt_predictor
from torchrl_tit.objectives import MaskedDTLoss

from ..finite import check_finite
from ..offline.state import TrainingState
from ..offline.training import Training, run_updates
from ..recipe import check_at_least
from ..run import Run
from .data import load_data, warn_of_targets
from .recipe import SequenceRecipe

TERMS = ["loss", "gradient_norm"]


@dataclass(frozen=True, kw_only=True)
class DT(SequenceRecipe):
    """Decision Transformer (arXiv 2106.01345) on a data set.

    The defaults are those of its paper's MuJoCo runs, which arXiv 2212.14538 repeats with DT_TIT.
    """

    algorithm: ClassVar[str] = "dt"

    iterations: int = 10
    """Evaluations of the network, one after each share of the updates."""
    updates_per_iteration: int = 10_000
    """Gradient steps before each evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, iterations=1, updates_per_iteration=1)
        if self.backbone.action_space == "gaussian":
            raise ValueError(
                "backbone.action_space is 'gaussian', which this loss cannot train: use "
                "'continuous', or an odt recipe"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.iterations * self.updates_per_iteration

    def evaluation_due(self, step: int) -> bool:
        """Whether an iteration ends after so many gradient steps."""
        return step % self.updates_per_iteration == 0

    def train(self, run: Run) -> None:
        """Trains in a run folder; see :func:`train`."""
        train(self, run)


def train(recipe: DT, run: Run) -> None:
    """Trains a network, from the newest checkpoint of the run where there is one.

    Args:
        recipe: the settings.
        run: an open run folder.

    Raises:
        FloatingPointError: if the loss or the gradient is not finite.
    """
    torch.set_num_threads(recipe.threads)
    torch.manual_seed(recipe.seed)
    episodes = load_data(recipe.dataset, recipe.backbone, **recipe.reading())
    warn_of_targets(recipe.target_returns, episodes)
    agent = recipe.make_agent()
    agent.fit_statistics(episodes)
    storage = SequenceStorage(
        episodes.to(recipe.torch_device()),
        recipe.backbone.context,
        mean=agent.mean if agent.normalizes else None,
        std=agent.std if agent.normalizes else None,
        return_scale=recipe.return_scale,
    )
    buffer = make_replay_buffer(storage, recipe.batch_size, seed=recipe.seed)
    discrete = recipe.backbone.action_space == "discrete"
    loss = MaskedDTLoss(
        make_dt_predictor(agent.network), loss_function="cross_entropy" if discrete else "l2"
    )
    parameters = list(agent.parameters())
    optimizer = torch.optim.AdamW(
        parameters, lr=recipe.learning_rate, weight_decay=recipe.weight_decay, fused=True
    )
    state = TrainingState(
        {"agent": agent, "optimizer": optimizer, "buffer": buffer}, recipe.evaluation_seed
    )

    def update(step: int) -> Tensor:
        optimizer.param_groups[0]["lr"] = recipe.learning_rate_at(step)
        total = loss(buffer.sample())["loss"]
        optimizer.zero_grad()
        total.backward()
        norm = nn.utils.clip_grad_norm_(parameters, recipe.max_grad_norm)
        terms = torch.stack([total.detach(), norm])
        check_finite(TERMS, terms, step, state.saved_step)
        optimizer.step()
        return terms

    run_updates([Training(recipe, run, agent, state)], TERMS, update)
