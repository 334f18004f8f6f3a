"""Gymnasium tasks as TorchRL environments."""

from torchrl_tit.envs.factory import make_env
from torchrl_tit.envs.vector import VectorEnv

__all__ = ["VectorEnv", "make_env"]
