"""Atari games as a TorchRL environment."""

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical, Unbounded

from torchrl_tit.envs.atari_games import AtariGames
from torchrl_tit.envs.vector import GymVectorEnv


class AtariEnv(GymVectorEnv):
    """N copies of an Atari game as one TorchRL environment.

    In addition to the entries of :class:`~torchrl_tit.envs.GymVectorEnv`, where ``observation`` is
    uint8 [N, 84, 84], it writes

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``game_over``           [N, 1]              bool, the game ended, not only a life
    ``game_return``         [N, 1]              float32, all points of the game so far
    ======================  ==================  ===================================================

    An episode is one life: losing it is a termination, and the next episode continues the same
    game, see :class:`~torchrl_tit.envs.AtariGames`. ``game_return`` includes points scored between
    two lives, so it can be more than the sum of the episodes' rewards. Rewards are the game's own
    points; for training, clip them with TorchRL's `SignTransform`. A reset without a ``_reset``
    entry starts new games in all copies.

    Args:
        games: The games.
        device: Device of the tensors; by default they stay on the CPU and the device is None.

    Example:
        >>> env = AtariEnv(AtariGames("pong", num_envs=2))
        >>> env.reset(seed=0)["observation"].shape
        torch.Size([2, 84, 84])
        >>> env.rollout(3)["next", "game_over"].any().item()
        False
        >>> env.close()
    """

    def __init__(self, games: AtariGames, *, device: torch.device | str | None = None) -> None:
        super().__init__(games, device=device)
        shape = (games.num_envs, 1)
        spec = self.observation_spec
        spec["game_over"] = Categorical(2, shape=shape, dtype=torch.bool, device=self.device)
        spec["game_return"] = Unbounded(shape, dtype=torch.float32, device=self.device)
        self.observation_spec = spec

    def _further(self, info: dict[str, Any]) -> dict[str, Tensor]:
        game_return = info["game_return"].astype("f4")
        return {
            "game_over": self._tensor(info["game_over"]).unsqueeze(-1),
            "game_return": self._tensor(game_return).unsqueeze(-1),
        }
