"""Steps of a robot with several observations and masks, and what a ring holds of them."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_tit.envs import make_env

MOST_FRAMES = 8
UNSTORED = ("done", "terminated", "truncated", "episode_reward", ("next", "episode_reward"))


@cache
def _play(envs: int | None, steps: int, padding: Any, seed: int) -> TensorDictBase:
    """Episodes of random length, some of which a time limit cuts off."""
    env = make_env(
        "tests.envs.tasks:Robot-v0",
        envs or 1,
        seed=seed,
        num_frames=MOST_FRAMES,
        padding=padding,
        observation_keys=["arm", "camera", "contacts"],
        mask_actions=True,
        max_episode_steps=6,
    )
    first = steps // 3
    parts = [env.rollout(count, break_when_any_done=False) for count in (first, steps - first)]
    played: Any = torch.cat(parts, -1)
    played = played.exclude(*UNSTORED)
    return played[0] if envs is None else played


def play_several(
    envs: int | None, steps: int, num_frames: int, padding: Any, seed: int = 0
) -> TensorDictBase:
    """Plays steps [envs, time], or [time] without envs, with histories of all observations.

    After a third, the environments are reset without a flag.
    """
    played = _play(envs, steps, padding, seed).copy()
    for group in (played, played["next"]):  # histories of more frames hold those of fewer
        newest = {
            name: history.narrow(played.ndim, MOST_FRAMES - num_frames, num_frames)
            for name, history in group["history"].items()
        }
        group["history"] = TensorDict(newest, played.batch_size)
    return played


def newest(steps: TensorDictBase, time: int, max_size: int) -> TensorDictBase:
    """What a ring holds when steps [envs, T] up to a time were written; [times, envs]."""
    steps = steps if steps.ndim == 1 else steps.transpose(0, 1)
    room = max_size // steps.shape[1:].numel()
    order = [max(range(slot, time, room)) for slot in range(min(time, room))]
    return steps[order]
