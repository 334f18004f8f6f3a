"""Atari games by the protocol of the deep Q-network, played side by side in C++."""

import secrets
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

_NOOP, _FIRE = 0, 1
_HEIGHT, _WIDTH = 210, 160  # of the screen
_SIZE = 84  # height and width of an observation
FRAME_SKIP = 4
MAX_NUM_FRAMES = 108_000  # of a game: half an hour
_GREY = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green and blue (ITU-R BT.601)


class AtariGames(VectorEnv):
    """N copies of an Atari game as a Gymnasium vector environment that does not reset by itself.

    The protocol is that of Stable-Baselines3's `AtariWrapper`: an action holds for 4 frames, of the
    last two the brighter pixels count, and the 84 x 84 picture is made by area interpolation. A new
    game begins with 1 to 30 frames without action. Losing a life ends the episode, but not the
    game: 4 frames later the next episode goes on with it. Where the game has a fire button, it is
    pressed for 4 frames at the start of each game and after each lost life, and action 2 follows
    for 4 frames. Actions are never repeated at random. Rewards are the game's own points.

    ale-py's `AtariVectorEnv` emulates and scales in threads of its own, one instance a game, since
    one instance cannot step only those of its games that have lost a life. Its own settings for
    this end the game at a lost life or never press fire. The scaled colours become grey here, as
    grey of the brightest colours is not the brightest grey; what remains between this and
    `AtariWrapper`, which takes grey before it scales, is one grey level of rounding.

    Reset with a seed and given the same actions, the games repeat exactly.

    Args:
        game: The game as ale-py's ROM files are called, such as "ms_pacman".
        num_envs: N, the number of games.
        noop_max: Most frames without action at the start of a game; with 0 there are none.
        max_num_frames_per_episode: Frames after which a game is cut off, where an action counts as
            4; those without action at its start do not count.
        render_mode: ``"rgb_array"`` emulates a second time, for pictures in full size.

    Raises:
        ValueError: If the game or the render mode is unknown, or a number of games or frames is
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

    def __init__(
        self,
        game: str,
        num_envs: int = 1,
        *,
        noop_max: int = 30,
        max_num_frames_per_episode: int = MAX_NUM_FRAMES,
        render_mode: str | None = None,
    ) -> None:
        from ale_py import roms  # an extra, which few need

        if game not in roms.get_all_rom_ids():
            raise ValueError(f"Unknown game {game!r}: ale-py has {roms.get_all_rom_ids()}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', but is {render_mode!r}.")
        for name, given, least in (
            ("num_envs", num_envs, 1),
            ("noop_max", noop_max, 0),
            ("max_num_frames_per_episode", max_num_frames_per_episode, 1),
        ):
            if given < least:
                raise ValueError(f"{name} must be at least {least}, but is {given}.")
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._noop_max = noop_max
        # The second emulators, for rendering, do whatever the first do.
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
        self._over = np.ones(num_envs, bool)  # a game that has not begun is over
        self._truncated = np.zeros(num_envs, bool)
        self._goes_on = np.zeros(num_envs, bool)  # in the next life, whose episode may begin
        self._returns = np.zeros(num_envs)
        self._noops = np.zeros(num_envs, int)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins episodes, with a new game or, where only some copies are named, the next life.

        Args:
            seed: Copy i is seeded with ``seed + i``, or with its own number.
            options: ``"reset_mask"``, bool [N], says which copies begin. Without it, or with a
                seed, all that begin do so with a new game.

        Returns:
            The observations, uint8 [N, 84, 84], and a dictionary: see :meth:`step`.
        """
        mask = (options or {}).get("reset_mask")
        asked = np.ones(self.num_envs, bool) if mask is None else mask
        if seed is None and not self._seeded:
            seed = secrets.randbelow(2**30)
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_envs)
        new = asked if mask is None or seed is not None else asked & ~self._goes_on
        self._begin(new.nonzero()[0], seed)
        self._goes_on &= ~asked
        return self._images.copy(), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Plays 4 frames of every game, and where a life is lost what leads to the next.

        Args:
            actions: int [N].

        Returns:
            The observations, uint8 [N, 84, 84]; the points, float64 [N]; whether a life or the game
            is lost and whether the game is cut off, bool [N]; and a dictionary of arrays [N]:
            ``game_over`` (bool, lost or cut off), ``game_return`` (float64, all points of the game
            so far), ``lives``, and ``noops`` (int, the frames without action at its start).
        """
        everyone = np.arange(self.num_envs)
        lives = self._lives.copy()
        rewards = self._play(everyone, actions)
        images, truncated = self._images.copy(), self._truncated.copy()
        # Some games show no life for a while before they end.
        lost = (self._lives < lives) & (self._lives > 0)
        terminated = (self._over & ~truncated) | lost
        going = (lost & ~self._over).nonzero()[0]
        for action in [_NOOP, *self._opening]:
            going = going[~self._over[going]]
            self._play(going, np.full(len(going), action))
        self._goes_on = lost & ~self._over
        return images, rewards, terminated, truncated, self._info()

    def render(self) -> tuple[np.ndarray, ...]:
        """Returns the screens: of each game uint8 [210, 160, 3].

        Raises:
            ValueError: If the games were made without ``render_mode="rgb_array"``.
        """
        if self.render_mode is None:
            raise ValueError('The games are rendered where render_mode="rgb_array" only.')
        return tuple(self._screens.copy())

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the emulators and their threads."""
        self._emulators = []

    def _begin(self, games: np.ndarray, seeds: Sequence[int] | None) -> None:
        """Begins new games."""
        self._seeded = True
        for i in games:
            outcomes = self._restart(i, None if seeds is None else seeds[i])
            while self._noop_max and not outcomes[0][1]["episode_frame_number"][0]:
                outcomes = self._restart(i)  # ale-py draws the number of no-ops from 0 on
            self._look(i, [outcome[0] for outcome in outcomes])
            self._noops[i] = outcomes[0][1]["episode_frame_number"][0]
            self._lives[i] = outcomes[0][1]["lives"][0]
        self._over[games] = self._truncated[games] = False
        self._returns[games] = 0
        for action in self._opening:
            self._play(games, np.full(len(games), action))

    def _restart(self, i: int, seed: int | None = None) -> list[tuple[np.ndarray, dict[str, Any]]]:
        if seed is not None:
            seed %= 2**31  # more than ale-py takes
        return [emulator.reset(seed=seed) for emulator in self._emulators[i]]

    def _play(self, games: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Plays one action in some of the games and returns their points."""
        rewards = np.zeros(len(games))
        for i, action in zip(games, actions, strict=True):
            for emulator in self._emulators[i]:
                emulator.send(np.array([action], int))  # returns at once; threads do the work
        for k, i in enumerate(games):
            outcomes = [emulator.recv() for emulator in self._emulators[i]]
            self._look(i, [outcome[0] for outcome in outcomes])
            _, (rewards[k],), (over,), (self._truncated[i],), info = outcomes[0]
            self._over[i] = over or self._truncated[i]
            self._lives[i] = info["lives"][0]
        self._returns[games] += rewards
        return rewards

    def _look(self, i: int, pictures: Sequence[np.ndarray]) -> None:
        """Takes over what an emulator shows: of each size [1, 1, height, width, 3]."""
        self._images[i] = (pictures[0][0, 0] @ _GREY).round()
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
    from ale_py.vector_env import AtariVectorEnv

    return AtariVectorEnv(
        game,
        num_envs=1,
        num_threads=1,
        img_height=height,
        img_width=width,
        grayscale=False,
        stack_num=1,
        frameskip=FRAME_SKIP,
        noop_max=noop_max + 1,  # it draws one less at most
        max_num_frames_per_episode=max_frames,
        repeat_action_probability=0.0,
        reward_clipping=False,
        episodic_life=False,
        life_loss_info=False,
        use_fire_reset=False,
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
