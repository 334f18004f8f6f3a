"""Small tasks with observations and actions of all kinds."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple
from torchrl.envs import DTypeCastTransform


class Split(gymnasium.ObservationWrapper):
    """CartPole's observation in two parts."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, Box)
        low, high = space.low, space.high
        self.observation_space = Dict(cart=Box(low[:2], high[:2]), pole=Box(low[2:], high[2:]))

    def observation(self, observation):
        return {"cart": observation[:2], "pole": observation[2:]}


class Double(DTypeCastTransform):
    """Observations in float64."""

    def __init__(self) -> None:
        super().__init__(torch.float32, torch.float64, in_keys=["observation"])


class Paying(gymnasium.RewardWrapper):
    """Pays another reward in an episode's fifth step."""

    def __init__(self, env: gymnasium.Env, reward: str) -> None:
        super().__init__(env)
        self.value, self.steps = float(reward), 0

    def reset(self, **kwargs):
        self.steps = 0
        return self.env.reset(**kwargs)

    def reward(self, reward):
        self.steps += 1
        return self.value if self.steps == 5 else float(reward)


class Mixed(gymnasium.Env):
    """Random observations of several kinds, any actions, random masks, episodes of 5 to 9 steps."""

    def __init__(self, action_space: Space) -> None:
        self.action_space = action_space
        self.observation_space = Dict(
            image=Box(0, 255, (12, 12, 3), np.uint8),
            state=Tuple([Box(-1, 1, (3,), np.float32), Discrete(4, start=-1)]),
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        if seed is not None:
            self.observation_space.seed(seed)
        self.left = int(self.np_random.integers(5, 10))
        return self._observed()

    def step(self, action):
        assert self.action_space.contains(action), action
        self.left -= 1
        observation, info = self._observed()
        return observation, float(self.np_random.normal()), self.left == 0, False, info

    def _observed(self):
        if isinstance(self.action_space, Discrete):
            sizes = [int(self.action_space.n)]
        elif isinstance(self.action_space, MultiDiscrete):
            sizes = self.action_space.nvec.tolist()
        else:
            return self.observation_space.sample(), {}
        masks = [np.asarray(self.np_random.random(n) < 0.5) for n in sizes]
        for mask in masks:
            mask[self.np_random.integers(len(mask))] = True
        return self.observation_space.sample(), {"action_mask": np.concatenate(masks)}


ACTIONS = {
    "Discrete": Discrete(3, start=2),
    "MultiDiscrete": MultiDiscrete([3, 2, 4]),
    "MultiBinary": MultiBinary((2, 2)),
    "Box": Box(-1, 1, (2, 2), np.float32),
}
for name, space in ACTIONS.items():
    gymnasium.register(f"{name}Actions-v0", f"{__name__}:Mixed", kwargs={"action_space": space})


class Corridor(gymnasium.Env):
    """One step to the left or to the right at a time; a reward at the far end alone."""

    action_space = Discrete(2)
    observation_space = Box(0, 1, (1,), np.float32)

    def __init__(self, length: int = 24) -> None:
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.place = 0
        return self._observed(), {}

    def step(self, action):
        self.place = max(0, self.place + (1 if action else -1))
        arrived = self.place == self.length
        return self._observed(), float(arrived), arrived, False, {}

    def _observed(self):
        return np.array([self.place / self.length], np.float32)


gymnasium.register("Corridor-v0", f"{__name__}:Corridor", max_episode_steps=40)
