"""Gymnasium tasks as TorchRL environments."""

from torchrl_tit.envs.factory import make_env
from torchrl_tit.envs.vector import GymVectorEnv

__all__ = ["GymVectorEnv", "make_env"]
