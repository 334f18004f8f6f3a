"""Gymnasium tasks, Atari games and any TorchRL environment, with the same keys and spec kinds."""

from __future__ import annotations

from torchrl_tit.envs.atari import AtariEnv, AtariGames
from torchrl_tit.envs.factory import (
    TransformedVectorEnv,
    is_atari,
    make_env,
    make_games,
    time_limit,
)
from torchrl_tit.envs.spaces import observation_keys, observation_specs
from torchrl_tit.envs.torchrl_tasks import TorchRLTask
from torchrl_tit.envs.vector import GymVectorEnv

__all__ = [
    "AtariEnv",
    "AtariGames",
    "GymVectorEnv",
    "TorchRLTask",
    "TransformedVectorEnv",
    "is_atari",
    "make_env",
    "make_games",
    "observation_keys",
    "observation_specs",
    "time_limit",
]
