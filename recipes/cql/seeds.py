"""Runs of continuous CQL that differ in the seed alone, trained side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..offline.state import TrainingState
from ..offline.training import Training, run_updates
from ..run import Run

if TYPE_CHECKING:
    from .continuous import CQL


def train_seeds(recipe: CQL, runs: Sequence[Run]) -> None:
    """Trains an agent for each run, one gradient step of all at a time.

    Every run starts with the weights, and sees the batches, that it would alone; dropout and the
    policy's samples come from one random generator and are others than alone. What a run saves
    fits a single run.

    Args:
        recipe: the settings of all but the seed, which is that of each run's recipe.
        runs: open run folders.

    Raises:
        FloatingPointError: if a loss of a run is not finite.
    """
    torch.set_num_threads(recipe.threads)
    episodes = recipe.load_data()
    recipes = [replace(recipe, seed=run.recipe.seed) for run in runs]
    agents, buffers = [], []
    for one in recipes:
        torch.manual_seed(one.seed)
        buffers.append(one.make_buffer(episodes))
        agents.append(one.make_agent())
    update, optimizers = recipe.make_stacked_update(agents)
    trainings = []
    for index, (one, run) in enumerate(zip(recipes, runs, strict=True)):
        shares = {name: OptimizerShare(whole, index) for name, whole in optimizers.items()}
        parts = {"agent": agents[index], **shares, "buffer": buffers[index]}
        state = TrainingState(parts, recipe.evaluation_seed)
        trainings.append(Training(one, run, agents[index], state))

    def step(number: int) -> Tensor:
        # One cut for all seeds, where each has drawn its own indices.
        drawn = [b.sampler.sample(b.storage, recipe.batch_size)[0] for b in buffers]
        batch = buffers[0].storage.get(torch.stack(drawn))  # [seeds, B]
        return update(batch, number, trainings[0].state.saved_step)

    run_updates(trainings, update.TERMS, step)


class OptimizerShare:
    """One seed's share of Adam over stacked weights, saved as Adam of that seed alone.

    Args:
        optimizer: over weights [seeds, ...].
        index: of the seed.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, index: int) -> None:
        self.optimizer = optimizer
        self.index = index

    def state_dict(self) -> dict[str, Any]:
        """Returns the seed's state; the count of steps is that of all."""
        whole = self.optimizer.state_dict()
        state = {
            number: {k: v if k == "step" else v[self.index] for k, v in entries.items()}
            for number, entries in whole["state"].items()
        }
        return {**whole, "state": state}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Takes the seed's state over; the settings stay what they are."""
        weights = [weight for group in self.optimizer.param_groups for weight in group["params"]]
        for number, entries in state_dict["state"].items():
            state = self.optimizer.state[weights[number]]
            for name, value in entries.items():
                if name == "step":
                    state[name] = value.to(weights[number].device)
                else:
                    whole = state.setdefault(name, torch.zeros_like(weights[number]))
                    whole[self.index] = value.to(whole.device)
