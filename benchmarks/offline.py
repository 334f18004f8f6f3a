"""One update of CQL_TIT, IQL and BC with K = 4: this library compared with d3rlpy, on one batch.

The settings are those of ``cql/enhanced-tit``, ``iql/enhanced-tit`` and ``bc/enhanced-tit``, but
observations are not normalized. Losses run as they are and compiled. Both libraries have the same
networks: d3rlpy's actor reads the four observations through our Enhanced_TIT, and its critics read
the newest one. Its behavior cloning is of squared errors, ours of likelihoods.

d3rlpy pins a different version of Gymnasium from this project's, for environments that are not
needed here. Install it without its dependencies:
``pip install --no-deps -r benchmarks/d3rlpy.txt``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from d3rlpy.algos import BCConfig, CQLConfig, IQLConfig
from d3rlpy.models.encoders import EncoderFactory, VectorEncoderFactory
from d3rlpy.torch_utility import TorchMiniBatch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from recipes.core.registry import get_recipe
from torchrl_tit.networks import build_network

from .measuring import ratios, take_turns

ROUNDS, SECONDS = 7, 1.0
OBSERVATION, ACTION, FRAMES = 11, 3, 4


def recipe_of(algorithm: str) -> Any:
    """The recipe of an algorithm for any data, on a task with Hopper's sizes."""
    recipe: Any = get_recipe(f"{algorithm}/enhanced-tit")
    return replace(recipe, env="Hopper-v5", normalize_observations=False)


class _Then(nn.Module):
    """Changes observations before a network reads them."""

    def __init__(self, change: Callable[[Tensor], Tensor], network: nn.Module) -> None:
        super().__init__()
        self.change, self.network = change, network

    def forward(self, x: Tensor, *action: Tensor) -> Tensor:
        return self.network(self.change(x), *action)


@dataclass()
class TITEncoderFactory(EncoderFactory):
    """Gives d3rlpy's policy the actor's network, on the four observations in one row."""

    def create(self, observation_shape: Any) -> nn.Module:
        """Builds the network."""
        network = build_network(recipe_of("bc").backbone, (OBSERVATION,))
        return _Then(lambda x: x.unflatten(-1, (FRAMES, OBSERVATION)), network)

    @staticmethod
    def get_type() -> str:
        """A name that d3rlpy's configuration needs."""
        return "tit"


@dataclass()
class NewestEncoderFactory(VectorEncoderFactory):
    """Gives d3rlpy's value networks the newest observation."""

    def create(self, observation_shape: Any) -> Any:
        """Builds a network of the observation."""
        return _Then(_newest, super().create((OBSERVATION,)))

    def create_with_action(self, observation_shape: Any, *args: Any, **kwargs: Any) -> Any:
        """Builds a network of observation and action."""
        return _Then(_newest, super().create_with_action((OBSERVATION,), *args, **kwargs))


def _newest(x: Tensor) -> Tensor:
    return x[..., -OBSERVATION:]


def make_batch() -> TensorDictBase:
    """Random transitions with histories."""

    def states() -> dict[str, Tensor]:
        history = torch.randn(256, FRAMES, OBSERVATION)
        return {"observation": history[:, -1], "history": history}

    ends = torch.rand(256, 1) < 0.01
    following = {**states(), "reward": torch.rand(256, 1), "terminated": ends, "done": ends}
    action = torch.rand(256, ACTION) * 1.98 - 0.99
    return TensorDict({**states(), "action": action, "next": following}, [256])


def make_ours(
    recipe: Any, compile: Literal["on", "off"] = "off"
) -> Callable[[TensorDictBase], Any]:
    """Our update."""
    algorithm = replace(recipe, compile=compile).build()
    algorithm.make_buffer = ReplayBuffer  # batches are made here
    algorithm.prepare(0, Path())
    return lambda batch: algorithm.update(batch.copy(), 0)  # losses write into it


def make_theirs(recipe: Any) -> Callable[[TensorDictBase], Any]:
    """The update of d3rlpy."""
    actor = TITEncoderFactory()
    if recipe.algorithm == "bc":
        config: Any = BCConfig(learning_rate=recipe.learning_rate, encoder_factory=actor)
    else:
        values = NewestEncoderFactory(list(recipe.critic_hidden))
        shared = {"actor_encoder_factory": actor, "critic_encoder_factory": values}
        config = IQLConfig(**shared, value_encoder_factory=values)
        if recipe.algorithm == "cql":
            config = CQLConfig(
                **shared,
                alpha_learning_rate=0.0,
                initial_alpha=1.0,
                n_action_samples=recipe.action_samples,
            )
    algorithm = config.create(device="cpu:0")
    algorithm.create_impl((FRAMES * OBSERVATION,), ACTION)

    def update(batch: TensorDictBase) -> Any:
        step = batch["next"]
        converted = TorchMiniBatch(
            observations=batch["history"].flatten(1),
            actions=batch["action"],
            rewards=step["reward"],
            next_observations=step["history"].flatten(1),
            next_actions=batch["action"],  # not read
            returns_to_go=step["reward"],  # not read
            terminals=step["terminated"].float(),
            intervals=torch.ones(len(batch), 1),
            device="cpu:0",
        )
        return algorithm.impl.update(converted, 0)

    return update


def main() -> dict[str, Any]:
    """Measures milliseconds an update, alternating."""
    found, batch = {}, make_batch()
    for name in ("cql", "iql", "bc"):
        recipe = recipe_of(name)
        steps = {
            "d3rlpy": make_theirs(recipe),
            "this library": make_ours(recipe),
            "compiled": make_ours(recipe, "on"),
        }
        times = take_turns({k: partial(step, batch) for k, step in steps.items()}, ROUNDS, SECONDS)
        found[name] = {"ms": times, "ratios": ratios(times["d3rlpy"], times["this library"])}
    return found
