"""One update of CQL_TIT: this library compared with d3rlpy, with the same networks and batches.

The networks are those of the paper's hopper-medium-replay: batch 256, two critics of three layers
of 256, 30 actions in each state, an Enhanced_TIT of width 128 as actor, K = 1. Both update
everything once: temperature, critics, actor, targets. The floor is the time of the critics' matrix
products alone, each computed as one product in PyTorch.

d3rlpy pins a different version of Gymnasium from this project's, for environments that are not
needed here. Install it without its dependencies:
``pip install --no-deps -r benchmarks/d3rlpy.txt``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from d3rlpy.algos import CQLConfig
from d3rlpy.models.encoders import EncoderFactory, VectorEncoderFactory
from d3rlpy.torch_utility import TorchMiniBatch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from recipes.core.recipe import Compile
from recipes.core.registry import RECIPES
from recipes.cql import CQL, CQLAlgorithm
from torchrl_tit.networks import build_network

from .measuring import ratios, take_turns

ROUNDS, SECONDS = 10, 1.0
OBSERVATION, ACTION = 11, 3


@dataclass()
class TITEncoderFactory(EncoderFactory):
    """Gives d3rlpy's policy the actor's network."""

    def create(self, observation_shape: Any) -> nn.Module:
        """Builds the network."""
        return _Newest(build_network(get_recipe().backbone, (OBSERVATION,)))

    @staticmethod
    def get_type() -> str:
        """A name that d3rlpy's configuration needs."""
        return "tit"


class _Newest(nn.Module):
    """A network of K = 1 on observations without a time axis."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x.unsqueeze(-2))


def get_recipe() -> CQL:
    """The paper's recipe."""
    recipe = RECIPES["cql/hopper-medium-replay-v0/enhanced-tit"]
    assert isinstance(recipe, CQL)
    return recipe


def make_batch() -> TensorDictBase:
    """Random transitions."""

    def states() -> dict[str, Tensor]:
        observation = torch.randn(256, OBSERVATION)
        return {"observation": observation, "history": observation.unsqueeze(1)}

    ends = torch.rand(256, 1) < 0.01
    return TensorDict(
        {
            **states(),
            "action": torch.rand(256, ACTION) * 2 - 1,
            "next": {
                **states(),
                "reward": torch.rand(256, 1),
                "terminated": ends,
                "done": ends,
            },
        },
        [256],
    )


def make_ours(compiled: Compile) -> Callable[[TensorDictBase], Any]:
    """Our update."""
    algorithm = _WithoutData(replace(get_recipe(), compile=compiled))
    algorithm.prepare(0, Path())
    return lambda batch: algorithm.update(batch, 0)


class _WithoutData(CQLAlgorithm):
    """The algorithm without the data set: batches are made here."""

    def make_buffer(self) -> ReplayBuffer:
        return ReplayBuffer()


def make_theirs() -> Callable[[TensorDictBase], Any]:
    """The update of d3rlpy, where the weight of the conservative term applies to each critic."""
    recipe = get_recipe()
    algorithm = CQLConfig(
        actor_learning_rate=recipe.actor_learning_rate,
        critic_learning_rate=recipe.critic_learning_rate,
        temp_learning_rate=recipe.temperature_learning_rate,
        alpha_learning_rate=0.0,
        initial_alpha=1.0,
        batch_size=recipe.batch_size,
        conservative_weight=recipe.conservative_weight / 2,
        n_action_samples=recipe.action_samples,
        actor_encoder_factory=TITEncoderFactory(),
        critic_encoder_factory=VectorEncoderFactory(list(recipe.critic_hidden)),
    ).create(device="cpu:0")
    algorithm.create_impl((OBSERVATION,), ACTION)
    assert algorithm.impl is not None

    def update(batch: TensorDictBase) -> Any:
        step = batch["next"]
        converted = TorchMiniBatch(
            observations=batch["observation"],
            actions=batch["action"],
            rewards=step["reward"],
            next_observations=step["observation"],
            next_actions=batch["action"],  # not read
            returns_to_go=step["reward"],  # not read
            terminals=step["terminated"].float(),
            intervals=torch.ones(len(batch), 1),
            device="cpu:0",
        )
        return algorithm.impl.update(converted, 0)

    return update


def make_floor() -> Callable[[TensorDictBase], Any]:
    """The critics' matrix products: 31 actions in each state, the target, and the actor's loss."""
    recipe = get_recipe()
    widths = [OBSERVATION + ACTION, *recipe.critic_hidden, 1]
    layers = [
        (torch.randn(a, b), torch.randn(256 * (3 * recipe.action_samples + 1), max(a, b)))
        for a, b in pairwise(widths)
    ]

    def products(batch: TensorDictBase) -> None:
        with torch.no_grad():
            for _ in range(2):  # critics
                for index, (weight, rows) in enumerate(layers):
                    a, b = weight.shape
                    x, y = rows[:, :a].contiguous(), rows[:, :b].contiguous()
                    x @ weight
                    x.T @ y
                    if index:  # gradients of states and actions are not needed
                        y @ weight.T
                    x[:256] @ weight  # target
                    x[:256] @ weight  # the actor's loss, and the backward pass to its action
                    y[:256] @ weight.T

    return products


def main() -> dict[str, Any]:
    """Measures milliseconds an update, alternating."""
    updates = {
        "d3rlpy": make_theirs(),
        "this library": make_ours("off"),
        "this library, its policy compiled": make_ours("on"),
        "the critics' matrix products alone": make_floor(),
    }
    batch = make_batch()
    steps = {name: partial(update, batch) for name, update in updates.items()}
    times = take_turns(steps, ROUNDS, SECONDS)
    theirs, *ours, floor = times
    above = {
        name: [a - b for a, b in zip(taken, times[floor], strict=True)]
        for name, taken in times.items()
    }
    return {
        "ms": times,
        "ratios": {name: ratios(times[theirs], times[name]) for name in ours},
        "ratios_beside_the_floor": {name: ratios(above[theirs], above[name]) for name in ours},
    }
