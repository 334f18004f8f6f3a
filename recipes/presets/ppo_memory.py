"""The named recipes of tasks that require memory, for seven kinds of memory.

All networks have the same frame encoder and about the same number of weights, and train with the
same PPO settings on all tasks, but for a few fields in T-Mazes. They differ in how they remember:
the last four observations side by side, a recurrent state (four kinds), a gated transformer over
the last K observations, and TIT's outer blocks.
docs/results/memory.md describes how the settings were found, and the results.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl_tit.settings import (
    LSTM,
    MLP,
    GatedDeltaNet,
    GTrXL,
    HistorySettings,
    Inner,
    Mamba2,
    MinGRU,
    Network,
)

from .ppo_settings import STEADY_PPO_SETTINGS, reliable_tit
from .preset import PPO, Preset, of_networks

MEMORY_SETTINGS: dict[str, Any] = STEADY_PPO_SETTINGS | {
    "num_envs": 16,
    "steps_per_batch": 2048,
    "sequence_length": 64,  # by default 16; K - 1 frames more are encoded for each sequence
    "epochs": 8,
    # Less noise in the advantage of the one step where memory decides.
    "gae_lambda": 0.8,
    # An agent in a hurry, or sure too early, does not find out what there is to remember.
    "gamma": 0.995,
    "entropy_coeff": 0.01,
}
"""The settings of all PPO recipes on arrays, but for these fields."""

_T_MAZES = {10: 100_000, 50: 400_000, 250: 2_000_000, 500: 4_000_000}
"""The number of steps by the corridor's length: 8,000 episodes or more. K frames just reach the cue
at the junction."""

_REPEATS = {"easy": (32, 500_000), "medium": (32, 500_000), "hard": (64, 1_000_000)}
"""Frames K and the number of steps of POPGym's RepeatPrevious by difficulty: 4, 32 or 64 steps
back."""

_MINIGRIDS = {
    "S7": 1_000_000,
    "S9": 2_000_000,
    **dict.fromkeys(("S11", "S13", "S17Random"), 4_000_000),
}
"""The number of steps by the maze: its size, which varies up to it where it is random."""

VIEW = (
    "minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=8)",
    "minigrid.wrappers:ImgObsWrapper",
    "torchrl_tit.tasks:FirstActions(count=3)",  # left, right, forward
)
"""The wrappers of MiniGrid: a picture of tiles of 8 pixels, and three actions."""


_RECURRENT: dict[str, HistorySettings] = {
    "lstm": LSTM(hidden_dim=64),
    "mingru": MinGRU(),
    "gated-deltanet": GatedDeltaNet(value_dim=24),
    "mamba2": Mamba2(num_heads=4, value_dim=28),
}
"""The history encoders that carry a state."""


def _t_maze_settings(length: int) -> dict[str, Any]:
    """Sequences as long as an episode, so that an LSTM's gradient reaches the cue.

    An agent that has learned to walk before it has seen a junction must not be too sure there. As
    nearly all advantages become 0, the few others must not be divided by almost nothing. The floor,
    in standard deviations of the return, falls with the price of a step, which is 1 / length: an
    entropy bonus that is worth more than a step would keep the agent from walking.
    """
    floor = min(0.5, 25 / length)
    settings = MEMORY_SETTINGS | {"entropy_coeff": 0.05, "advantage_floor": floor}
    if length < 128:
        return settings
    steps = 2 ** length.bit_length()
    batch = {"steps_per_batch": 16 * steps, "minibatch_size": 2 * steps}
    return settings | {**batch, "sequence_length": steps}


def memory_networks(num_frames: int, *, patch_size: int | None = None) -> dict[str, Network]:
    """Returns the memories by name.

    Args:
        num_frames: number K of observations; it counts for attention only.
        patch_size: pixels along a side of an image's patch; an array is one patch.
    """
    patch: dict[str, Any] = {"patch_size": patch_size or "auto", "patch_weights": "own"}
    # Rotary positions find a frame by its distance sooner than learned ones.
    tit = reliable_tit("enhanced-tit", num_frames, temporal_positions="rotary", **patch)
    # TIT's inner transformer; the other networks read only the class token of its last block.
    last = Inner(every_block=False, **patch)
    return {
        "frames-4": replace(tit, frame=last, history=MLP(hidden_dim=96), num_frames=4),
        **{
            name: replace(tit, frame=last, history=history, num_frames=1)
            for name, history in _RECURRENT.items()
        },
        "gtrxl": replace(tit, frame=last, history=GTrXL(num_blocks=1, num_heads=1)),
        "enhanced-tit": tit,
    }


def _named() -> list[Preset]:
    recipes = []
    for length, total_steps in _T_MAZES.items():
        recipes += of_networks(
            PPO,
            f"ppo/tmaze-{length}",
            memory_networks(length + 1),
            env="TMaze-v0",
            env_settings=(f"corridor_length={length}", "end_when_behind=True"),
            total_steps=total_steps,
            **_t_maze_settings(length),
        )
    for difficulty, (num_frames, total_steps) in _REPEATS.items():
        recipes += of_networks(
            PPO,
            f"ppo/repeat-previous-{difficulty}",
            memory_networks(num_frames),
            env=f"popgym-RepeatPrevious{difficulty.title()}-v0",
            total_steps=total_steps,
            **MEMORY_SETTINGS,
        )
    # As in arXiv 2505.15040: a view of 3 x 3 tiles, and episodes are truncated after 96 steps.
    # `max_steps=96` would truncate them too, but a step would then cost 0.9 / 96 of the reward
    # instead of 0.9 / 245 on S7, and looking at the cue would not pay. A patch is a tile.
    for maze, total_steps in _MINIGRIDS.items():
        recipes += of_networks(
            PPO,
            f"ppo/memory-{maze.lower()}",
            memory_networks(32, patch_size=8),
            env=f"MiniGrid-Memory{maze}-v0",
            env_settings=("agent_view_size=3", "max_episode_steps=96"),
            wrappers=VIEW,
            total_steps=total_steps,
            **MEMORY_SETTINGS,
        )
    return recipes


RECIPES: list[Preset] = _named()
