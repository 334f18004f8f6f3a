"""Gymnasium tasks and Atari games as TorchRL environments."""

from torchrl_tit.envs.atari import AtariEnv
from torchrl_tit.envs.atari_games import AtariGames
from torchrl_tit.envs.factory import (
    VectorizationMode,
    is_atari,
    make_env,
    make_games,
    time_limit,
)
from torchrl_tit.envs.transformed import TransformedVectorEnv
from torchrl_tit.envs.vector import GymVectorEnv

__all__ = [
    "AtariEnv",
    "AtariGames",
    "GymVectorEnv",
    "TransformedVectorEnv",
    "VectorizationMode",
    "is_atari",
    "make_env",
    "make_games",
    "time_limit",
]
