"""Atari games as a TorchRL environment."""

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical, Unbounded

from torchrl_tit.envs.atari_games import AtariGames
from torchrl_tit.envs.vector import GymVectorEnv


class AtariEnv(GymVectorEnv):
    """N copies of an Atari game, with history and returns, as one TorchRL environment.

    Beyond the entries of :class:`~torchrl_tit.envs.GymVectorEnv`, of which ``observation`` is uint8
    [N, 84, 84], it writes

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``game_over``           [N, 1]              bool, the game has ended, not only a life
    ``game_return``         [N, 1]              float32, all points of the game so far
    ======================  ==================  ===================================================

    An episode is one life: its end is a termination, and the next one goes on with the same game,
    see :class:`~torchrl_tit.envs.AtariGames`. ``game_return`` also counts points that fall between
    two lives, so it can be more than the sum of the episodes' rewards. Rewards are the game's own:
    for training, let TorchRL's `SignTransform` clip them. A reset that does not say which copies
    (no ``_reset`` entry) begins new games in all of them.

    Args:
        games: The games.
        **kwargs: ``history``, ``padding`` and ``device`` of
            :class:`~torchrl_tit.envs.GymVectorEnv`.

    Example:
        >>> env = AtariEnv(AtariGames("pong", num_envs=2), history=4)
        >>> env.reset(seed=0)["history"].shape
        torch.Size([2, 4, 84, 84])
        >>> env.rollout(3)["next", "game_over"].any().item()
        False
        >>> env.close()
    """

    def __init__(self, games: AtariGames, **kwargs: Any) -> None:
        super().__init__(games, **kwargs)
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
