"""Gymnasium tasks and Atari games as TorchRL environments."""

from torchrl_tit.envs.atari import AtariEnv
from torchrl_tit.envs.atari_games import AtariGames
from torchrl_tit.envs.factory import VectorizationMode, make_env
from torchrl_tit.envs.vector import GymVectorEnv

__all__ = ["AtariEnv", "AtariGames", "GymVectorEnv", "VectorizationMode", "make_env"]
