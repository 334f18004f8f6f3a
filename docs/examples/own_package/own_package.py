"""A frame encoder, a history encoder, a task, an algorithm and a recipe of one's own.

docs/extending.md explains them. `pip install ./examples/own_package` makes them known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.objectives.value.functional import reward2go

from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import finished_returns
from torchrl_tit.frames import FrameEncoder
from torchrl_tit.histories import HistoryEncoder, HistoryShape
from torchrl_tit.modules import Backbone, history_keys, make_actor
from torchrl_tit.networks import build_network
from torchrl_tit.recipes import (
    Algorithm,
    Recipe,
    check_finite,
    make_task,
    register_recipes,
    seed_copies,
)
from torchrl_tit.settings import FrameSettings, HistorySettings, Network

# A frame encoder


@dataclass(frozen=True, kw_only=True)
class Fourier(FrameSettings, name="fourier", builds=f"{__name__}:FourierEncoder"):
    """One token: sines and cosines of the observation's entries, and a linear layer."""

    num_frequencies: int = 4
    """Number of frequencies: 1, 2, 4, ... quarter turns for a unit."""
    embed_dim: int = 32
    """Width D of the token."""

    def __post_init__(self) -> None:
        if self.num_frequencies < 1:
            raise ValueError(f"num_frequencies must be at least 1, not {self.num_frequencies}")


class FourierEncoder(FrameEncoder):
    kinds = ("array",)

    def __init__(self, settings: Fourier, observation_shape: Sequence[int]) -> None:
        super().__init__(observation_shape, num_tokens=1, width=settings.embed_dim)
        frequencies = math.pi / 2 * 2.0 ** torch.arange(settings.num_frequencies)
        self.register_buffer("frequencies", frequencies)
        entries = 2 * settings.num_frequencies * math.prod(observation_shape)
        self.linear = nn.Linear(entries, settings.embed_dim)

    def forward(self, observation: Tensor) -> Tensor:  # [..., entries] -> [..., L = 1, D]
        angles = (observation.unsqueeze(-1) * self.frequencies).flatten(-2)
        return self.linear(torch.cat([angles.sin(), angles.cos()], -1)).unsqueeze(-2)


# A history encoder


@dataclass(frozen=True, kw_only=True)
class Recency(HistorySettings, name="recency", builds=f"{__name__}:RecencyEncoder"):
    """The mean of the K frames' tokens, in which older frames weigh less; how much is learned."""

    initial_decay: float = 0.5
    """Weight of a frame as a multiple of the next one's, before training."""


class RecencyEncoder(HistoryEncoder):
    def __init__(self, settings: Recency, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=shape.num_tokens * shape.width)
        self.decay = nn.Parameter(torch.tensor(settings.initial_decay).logit())
        self.register_buffer("age", torch.arange(shape.num_frames - 1, -1, -1.0))

    def forward(self, tokens: Tensor) -> Tensor:  # [..., K, L, D] -> [..., L * D]
        weights = self.decay.sigmoid() ** self.age  # [K]
        return torch.einsum("k,...kld->...ld", weights / weights.sum(), tokens).flatten(-2)


# A task


class Line(gymnasium.Env[np.ndarray, np.int64]):
    """Walk along a line, from 0 to a goal at -1 or 1, which is seen in the first step only."""

    observation_space = gymnasium.spaces.Box(-2.0, 2.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.goal = 0.0, float(self.np_random.choice([-1.0, 1.0]))
        return np.array([self.position, self.goal], np.float32), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.position += 0.25 if action else -0.25
        there = abs(self.position) >= 1
        reward = 1.0 if there and self.position * self.goal > 0 else -0.05
        return np.array([self.position, 0.0], np.float32), reward, there, False, {}

    def render(self) -> np.ndarray:
        image = np.zeros((16, 80, 3), np.uint8)  # the walker is red, the goal green
        for x, channel in ((self.position, 0), (self.goal, 1)):
            image[:, int(40 + 30 * x) - 4 : int(40 + 30 * x) + 4, channel] = 255
        return image


gymnasium.register("Line-v0", entry_point=f"{__name__}:Line", max_episode_steps=20)


# An algorithm


@dataclass(frozen=True, kw_only=True)
class Reinforce(Recipe, algorithm="reinforce"):
    """REINFORCE (Williams, 1992), with normalized returns to go."""

    total_steps: int = 100_000
    """Environment steps of the whole run."""
    steps_per_batch: int = 512
    """Environment steps between two updates."""
    num_envs: int = 8
    """Environments that are stepped side by side; must divide steps_per_batch."""
    learning_rate: float = 3e-3
    """Adam's learning rate."""
    gamma: float = 0.99
    """Discount."""

    def build(self) -> ReinforceAlgorithm:
        return ReinforceAlgorithm(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.backbone.carries_state:
            raise ValueError("reinforce carries no state: set backbone.num_frames to 2 or more")
        if self.steps_per_batch % self.num_envs:
            raise ValueError(
                f"num_envs {self.num_envs} does not divide steps_per_batch {self.steps_per_batch}"
            )

    @property
    def final_step(self) -> int:
        return self.total_steps


class ReinforceAlgorithm(Algorithm[Reinforce]):
    columns = ("loss",)

    def __init__(self, recipe: Reinforce) -> None:
        super().__init__(recipe)
        with closing(make_task(recipe)) as task:
            observation = observation_specs(task)  # one, or several by name
            network = build_network(recipe.backbone, observation)
            self.backbone = Backbone(network, in_keys=history_keys(observation))
            features, actions = self.backbone.features_dim, task.action_spec_unbatched
            self.actor = make_actor(features, actions, batch_dims=0)
        self.model = self.agent = TensorDictSequential(self.backbone, self.actor).to(self.device)

    @property
    def policy(self) -> TensorDictSequential:
        return self.agent

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        return make_task(self.recipe, num_envs, seed, **settings)

    def prepare(self, step: int, folder: Path) -> None:
        recipe = self.recipe
        self.optimizer = torch.optim.Adam(self.agent.parameters(), lr=recipe.learning_rate)
        self.collector = Collector(
            seed_copies(self.make_env(recipe.num_envs), recipe.seed, step),
            self.agent.eval(),
            frames_per_batch=recipe.steps_per_batch,
            total_frames=-1,  # the runner ends the loop
            auto_register_policy_transforms=False,
        )

    def state(self) -> Mapping[str, Any]:  # what a checkpoint holds beside the networks
        return {"optimizer": self.optimizer}

    def batches(self) -> Iterator[TensorDictBase]:  # [envs, time]
        return iter(self.collector)

    def size(self, batch: TensorDictBase) -> int:
        return batch.numel()

    def returns(self, batch: TensorDictBase) -> Tensor:
        return finished_returns(batch)

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor]:
        returns = reward2go(batch["next", "reward"], batch["next", "done"], self.recipe.gamma)
        advantages = ((returns - returns.mean()) / (returns.std() + 1e-6)).squeeze(-1)
        distribution = self.actor.get_dist(self.backbone(batch.select("history")))
        loss = -(distribution.log_prob(batch["action"]) * advantages).mean()
        check_finite(["loss"], loss.detach()[None])
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return {"loss": loss.detach()}

    def close(self) -> None:
        self.collector.shutdown()


# A recipe

register_recipes(
    Reinforce(
        name="own/line",
        env="Line-v0",
        backbone=Network(frame=Fourier(), history=Recency(), num_frames=4),
        total_steps=1024,  # shows that it runs; 10,000 learn the task
        evaluation_episodes=20,
    )
)
