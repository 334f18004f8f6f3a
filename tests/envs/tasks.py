"""Small tasks with spaces of every kind, which other tests name as "tests.envs.tasks:Robot-v0"."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space
from tensordict import TensorDict
from torchrl.data import Categorical, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase


class Speech(Space[str]):
    """Text in a space of its own, as MiniGrid's missions."""

    def __init__(self) -> None:
        super().__init__(dtype=str)

    def sample(self, mask=None, probability=None):
        return "bleep"

    def contains(self, x):
        return isinstance(x, str)

    def __eq__(self, other):
        return isinstance(other, Speech)

    __hash__ = Space.__hash__


class Robot(gymnasium.Env):
    """Pixels, numbers, categories and text, all by chance; some motors are blocked."""

    observation_space = Dict(
        {
            "arm": Dict({"gear": Discrete(4, start=1), "joint.angles": Box(-1, 1, (3,))}),
            "camera": Box(0, 255, (5, 6, 3), np.uint8),
            "contacts": MultiBinary(2),
            "speech": Speech(),
            "wheels": MultiDiscrete([3, 5], start=[0, -2]),
        }
    )
    action_space = MultiDiscrete([2, 3], start=[0, -1])
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's)

    def __init__(self, render_mode: str | None = None, length: int = 1_000) -> None:
        self.render_mode = render_mode
        self.length = length
        self.steps = 0
        self.camera = np.zeros((5, 6, 3), np.uint8)

    def _observe(self) -> tuple[dict[str, Any], dict[str, Any]]:
        draw = self.np_random
        self.camera = draw.integers(0, 256, (5, 6, 3), np.uint8)
        observation = {
            "arm": {"gear": draw.integers(1, 5), "joint.angles": draw.random(3, np.float32)},
            "camera": self.camera,
            "contacts": draw.integers(0, 2, 2, np.int8),
            "speech": "bleep",
            "wheels": np.array([draw.integers(3), draw.integers(-2, 3)]),
        }
        free = np.array([True, draw.random() < 0.5]), np.array([draw.random() < 0.5, True, False])
        return observation, {"action_mask": free}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observe()

    def step(self, action):
        assert self.action_space.contains(action)
        observation, info = self._observe()
        self.steps += 1
        ended = bool(self.np_random.random() < 0.2) or self.steps >= self.length
        return observation, float(action.sum()), ended, False, info

    def render(self):
        return self.camera.repeat(4, 0).repeat(4, 1)


class Echo(gymnasium.Env):
    """Observes what was done, and refuses what is not in its space of actions."""

    def __init__(self, actions: Space, observations: Space | None = None) -> None:
        self.action_space = actions
        self.observation_space = observations or Box(-9, 9, (), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        return self.observation_space.sample(), float(np.sum(action)), False, False, {}


class Corridor(EnvBase):
    """A TorchRL environment: a place on a line, with a wind by chance; both ends are good."""

    def __init__(self, half: int = 3) -> None:
        super().__init__()
        self.half, self.place = half, 0
        self.generator = torch.Generator()
        self.observation_spec = Composite(
            pixels=Unbounded((5, 2 * half + 1, 3), dtype=torch.uint8),
            place=OneHot(2 * half + 1),
            sensors=Composite(wind=Unbounded((), dtype=torch.float64)),
            allowed=Categorical(2, shape=(3,), dtype=torch.bool),
        )
        self.action_spec = OneHot(3)
        self.reward_spec = Unbounded((1,))
        self.done_spec = Categorical(2, shape=(1,), dtype=torch.bool)

    def _observe(self) -> TensorDict:
        column = self.place + self.half
        self.wind = torch.rand((), dtype=torch.float64, generator=self.generator)
        pixels = torch.zeros(5, 2 * self.half + 1, 3, dtype=torch.uint8)
        pixels[:, column] = 255
        place = torch.zeros(2 * self.half + 1, dtype=torch.bool)
        place[column] = True
        allowed = torch.tensor([True, self.wind > 0.2, True])
        entries = {"pixels": pixels, "place": place, "allowed": allowed}
        return TensorDict({**entries, "sensors": {"wind": self.wind}})

    def _reset(self, tensordict=None, **kwargs):
        self.place = 0
        return self._observe()

    def _step(self, tensordict):
        self.place += int(tensordict["action"].int().argmax()) - 1
        self.place += 1 if self.wind > 0.7 else 0
        self.place = max(-self.half, min(self.half, self.place))
        done = torch.tensor([abs(self.place) == self.half])
        return self._observe().update({"reward": done.float(), "done": done})

    def _set_seed(self, seed):
        self.generator.manual_seed(seed)


gymnasium.register("Robot-v0", f"{__name__}:Robot", max_episode_steps=50)
