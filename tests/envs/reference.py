"""What TorchRL's own wrapper and transforms make of the same tasks."""

import gymnasium
import torch
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
