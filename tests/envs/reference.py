"""What TorchRL's own wrapper and transforms make of the same tasks."""

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.envs import Compose, DoubleToFloat, EnvBase, GymWrapper, RewardSum, TransformedEnv

from torchrl_tit.transforms import History


def wrapped(name, num_envs, seed, num_frames, padding, **kwargs) -> EnvBase:
    """GymWrapper over a vector environment, under TorchRL's transforms."""
    tasks = SyncVectorEnv(
        [lambda: gymnasium.make(name, **kwargs)] * num_envs, autoreset_mode=AutoresetMode.DISABLED
    )
    transforms = [History(num_frames, padding=padding), RewardSum()]
    wrapper = GymWrapper(tasks, categorical_action_encoding=True)
    if wrapper.observation_spec["observation"].dtype is torch.float64:
        transforms.insert(0, DoubleToFloat())
    env = TransformedEnv(wrapper, Compose(*transforms))
    env.set_seed(seed)
    return env


class ImageTask(gymnasium.Env):
    """Random uint8 images for a few steps."""

    observation_space = Box(0, 255, (2, 4, 5), np.uint8)
    action_space = Discrete(3)

    def _image(self):
        return self.np_random.integers(0, 256, (2, 4, 5), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._image(), {}

    def step(self, action):
        return self._image(), float(action), bool(self.np_random.random() < 0.3), False, {}
