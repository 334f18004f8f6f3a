"""Atari games with the preprocessing of the deep Q-network, emulated in parallel in C++."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor
from torchrl.data import Categorical, Unbounded

from torchrl_tit.envs.vector import GymVectorEnv
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Copies, Probability, Steps, StepsOrNone

_NOOP, _FIRE = 0, 1
_HEIGHT, _WIDTH = 210, 160  # of the screen
_SIZE = 84  # height and width of an observation
FRAME_SKIP = 4
MAX_NUM_FRAMES = 108_000  # of a game: half an hour
_GREY = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green and blue (ITU-R BT.601)


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
        games: the games.
        device: device of the tensors; by default they stay on the CPU and the device is None.

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


class AtariGames(VectorEnv):
    """N copies of an Atari game as a Gymnasium vector environment without automatic resets.

    The preprocessing is that of Stable-Baselines3's `AtariWrapper`: an action is repeated for 4
    frames, the pixelwise maximum of the last two is taken, and the image is scaled to 84 x 84 by
    area interpolation. A new game starts with 1 to 30 no-op frames. Losing a life ends the episode,
    but not the game: the next episode continues it 4 frames later. If the game has a fire button,
    it is pressed for 4 frames at the start of each game and after each lost life, followed by
    action 2 for 4 frames. Actions are not sticky. Rewards are the game's own points.

    ale-py's `AtariVectorEnv` emulates and scales in its own threads. There is one instance per
    game, since an instance cannot step only some of its games (those that lost a life), and its own
    options for lost lives either end the game or never press fire. The conversion from scaled
    colors to gray is done here, since the gray of the maximum of colors is not the maximum of the
    grays. `AtariWrapper` converts before it scales; the difference is one gray level of rounding.

    Games that are reset with the same seed and given the same actions repeat exactly.

    Args:
        game: the name of ale-py's ROM file, such as "ms_pacman".
        num_envs: N, the number of games.
        noop_max: maximum number of no-op frames at the start of a game; 0 for none.
        max_num_frames_per_episode: number of frames (4 for each action) after which a game is
            truncated, not counting the no-op frames at its start.
        blank_probability: probability with which an observation is all zeros, each by itself: 0.5
            in flickering Pong (Hausknecht and Stone, arXiv 1507.06527, section 5).
        render_mode: ``"rgb_array"`` emulates each game a second time, for images in full size.

    Raises:
        ValueError: if the game or the render mode is unknown, or a number of games or frames is
            too small.

    Source: "Human-level control through deep reinforcement learning" (Mnih et al., 2015), methods.

    Example:
        >>> games = AtariGames("breakout", num_envs=2)
        >>> observation, info = games.reset(seed=0)
        >>> observation.shape, observation.dtype
        ((2, 84, 84), dtype('uint8'))
        >>> observation, reward, terminated, truncated, info = games.step(np.array([2, 3]))
        >>> info["game_over"], info["game_return"]
        (array([False, False]), array([0., 0.]))
        >>> games.close()
    """

    metadata = {  # noqa: RUF012 (Gymnasium's)
        "autoreset_mode": AutoresetMode.DISABLED,
        "render_modes": ["rgb_array"],
        "render_fps": 60 // FRAME_SKIP,
    }

    @checked_arguments
    def __init__(
        self,
        game: str,
        num_envs: Copies = 1,
        *,
        noop_max: StepsOrNone = 30,
        max_num_frames_per_episode: Steps = MAX_NUM_FRAMES,
        blank_probability: Probability = 0.0,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        from ale_py import roms  # an optional extra

        if game not in roms.get_all_rom_ids():
            raise ValueError(f"Unknown game {game!r}: ale-py has {roms.get_all_rom_ids()}.")
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._noop_max = noop_max
        self._blank_probability = blank_probability
        self._blanks = [np.random.default_rng() for _ in range(num_envs)]
        # The second emulators, for rendering, repeat the actions of the first.
        self._emulators: list[list[Any]] = [
            [
                _emulator(game, height, width, noop_max, max_num_frames_per_episode)
                for height, width in [(_SIZE, _SIZE), (_HEIGHT, _WIDTH)][: 2 if render_mode else 1]
            ]
            for _ in range(num_envs)
        ]
        actions = self._emulators[0][0].ale.get_action_set()
        self.single_observation_space = Box(0, 255, (_SIZE, _SIZE), np.uint8)
        self.single_action_space = Discrete(len(actions))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        has_fire = len(actions) > _FIRE and actions[_FIRE].name == "FIRE"
        self._opening = [_FIRE, *range(2, len(actions))][:2] if has_fire else []

        self._seeded = False
        self._images = np.zeros((num_envs, _SIZE, _SIZE), np.uint8)
        self._screens = np.zeros((num_envs, _HEIGHT, _WIDTH, 3), np.uint8)
        self._lives = np.zeros(num_envs, int)
        self._over = np.ones(num_envs, bool)  # also before the first game
        self._truncated = np.zeros(num_envs, bool)
        self._has_next_life = np.zeros(num_envs, bool)  # a life is lost, but the game is not over
        self._returns = np.zeros(num_envs)
        self._noops = np.zeros(num_envs, int)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes, each with a new game or with the next life.

        Args:
            seed: copy i gets ``seed + i``, or entry i of a sequence.
            options: ``"reset_mask"``, bool [N], selects the copies to reset; those that lost a life
                continue their game. Without a mask, or with a seed, all copies start new games.

        Returns:
            The observations, uint8 [N, 84, 84], and a dictionary: see :meth:`step`.
        """
        mask = (options or {}).get("reset_mask")
        asked = np.ones(self.num_envs, bool) if mask is None else mask
        if seed is None and not self._seeded:
            seed = secrets.randbelow(2**30)
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_envs)
        new = asked if mask is None or seed is not None else asked & ~self._has_next_life
        self._begin(new.nonzero()[0], seed)
        self._has_next_life &= ~asked
        return self._images.copy(), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Plays 4 frames of every game, and the frames between two lives if one is lost.

        Args:
            actions: int [N].

        Returns:
            The observations, uint8 [N, 84, 84]; the points, float64 [N]; whether a life or the game
            is lost, bool [N]; whether the game is truncated, bool [N]; and a dictionary of arrays
            [N]: ``game_over`` (bool, lost or truncated), ``game_return`` (float64, all points of
            the game so far), ``lives`` (int), and ``noops`` (int, the no-op frames at its start).
        """
        everyone = np.arange(self.num_envs)
        lives = self._lives.copy()
        rewards = self._play(everyone, actions)
        images, truncated = self._images.copy(), self._truncated.copy()
        # Some games report 0 lives for a while before they end.
        lost = (self._lives < lives) & (self._lives > 0)
        terminated = (self._over & ~truncated) | lost
        going = (lost & ~self._over).nonzero()[0]
        for action in [_NOOP, *self._opening]:
            going = going[~self._over[going]]
            self._play(going, np.full(len(going), action))
        self._has_next_life = lost & ~self._over
        return images, rewards, terminated, truncated, self._info()

    def render(self) -> tuple[np.ndarray, ...]:
        """Returns the screen of each game, uint8 [210, 160, 3].

        Raises:
            ValueError: if the games were made without ``render_mode="rgb_array"``.
        """
        if self.render_mode is None:
            raise ValueError('Games are rendered only with render_mode="rgb_array".')
        return tuple(self._screens.copy())

    def close_extras(self, **kwargs: Any) -> None:
        """Stops the emulators and their threads."""
        self._emulators = []

    def _begin(self, games: np.ndarray, seeds: Sequence[int] | None) -> None:
        """Starts new games."""
        self._seeded = True
        for i in games:
            outcomes = self._restart(i, None if seeds is None else seeds[i])
            while self._noop_max and not outcomes[0][1]["episode_frame_number"][0]:
                outcomes = self._restart(i)  # ale-py may draw 0 no-op frames
            self._look(i, [outcome[0] for outcome in outcomes])
            self._noops[i] = outcomes[0][1]["episode_frame_number"][0]
            self._lives[i] = outcomes[0][1]["lives"][0]
        self._over[games] = self._truncated[games] = False
        self._returns[games] = 0
        for action in self._opening:
            self._play(games, np.full(len(games), action))

    def _restart(self, i: int, seed: int | None = None) -> list[tuple[np.ndarray, dict[str, Any]]]:
        if seed is not None:
            self._blanks[i] = np.random.default_rng(seed)
            seed %= 2**31  # ale-py does not support larger seeds
        return [emulator.reset(seed=seed) for emulator in self._emulators[i]]

    def _play(self, games: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Plays one action in some of the games and returns their points."""
        rewards = np.zeros(len(games))
        for i, action in zip(games, actions, strict=True):
            for emulator in self._emulators[i]:
                emulator.send(np.array([action], int))  # returns at once; a thread emulates
        for k, i in enumerate(games):
            outcomes = [emulator.recv() for emulator in self._emulators[i]]
            self._look(i, [outcome[0] for outcome in outcomes])
            _, (rewards[k],), (over,), (self._truncated[i],), info = outcomes[0]
            self._over[i] = over or self._truncated[i]
            self._lives[i] = info["lives"][0]
        self._returns[games] += rewards
        return rewards

    def _look(self, i: int, pictures: Sequence[np.ndarray]) -> None:
        """Stores the images of a game's emulators, [1, 1, height, width, 3] each."""
        blank = self._blanks[i].random() < self._blank_probability
        self._images[i] = 0 if blank else (pictures[0][0, 0] @ _GREY).round()
        if self.render_mode:
            self._screens[i] = pictures[1][0, 0]

    def _info(self) -> dict[str, Any]:
        return {
            "game_over": self._over.copy(),
            "game_return": self._returns.copy(),
            "lives": self._lives.copy(),
            "noops": self._noops.copy(),
        }


def _emulator(game: str, height: int, width: int, noop_max: int, max_frames: int) -> Any:
    from ale_py.vector_env import AtariVectorEnv  # an optional extra

    return AtariVectorEnv(
        game,
        num_envs=1,
        num_threads=1,
        img_height=height,
        img_width=width,
        grayscale=False,
        stack_num=1,
        frameskip=FRAME_SKIP,
        noop_max=noop_max + 1,  # exclusive in ale-py
        max_num_frames_per_episode=max_frames,
        repeat_action_probability=0.0,
        reward_clipping=False,
        episodic_life=False,
        life_loss_info=False,
        use_fire_reset=False,
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
