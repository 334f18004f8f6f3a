"""An environment with several observations and masks of actions, and what a ring holds of it."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_tit.transforms import History

LEAVES = {
    "pixels": (torch.uint8, (4, 3)),
    "state": (torch.float32, (2,)),
    "cell": (torch.int64, (1,)),
}

MOST_FRAMES = 8


class SeveralEnv(EnvBase):
    """Random images, arrays and categories, and episodes of random length in each copy."""

    def __init__(self, batch_size: tuple[int, ...], seed: int) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        self.generator = torch.Generator().manual_seed(seed)
        leaves = {
            name: Unbounded((*batch_size, *shape), dtype=dtype)
            for name, (dtype, shape) in LEAVES.items()
        }
        self.observation_spec = Composite(
            observation=Composite(leaves, shape=batch_size),
            action_mask=Binary(2, (*batch_size, 2), dtype=torch.bool),
            shape=batch_size,
        )
        self.action_spec = Categorical(2, shape=batch_size)
        self.reward_spec = Unbounded((*batch_size, 1))
        self.full_done_spec = Composite(
            {
                name: Categorical(2, shape=(*batch_size, 1), dtype=torch.bool)
                for name in ("done", "terminated", "truncated")
            },
            shape=batch_size,
        )

    def _draw(self, *shape: int) -> torch.Tensor:
        return torch.rand(*self.batch_size, *shape, generator=self.generator)

    def _observe(self) -> TensorDict:
        leaves = {
            name: (self._draw(*shape) * 256).to(dtype) for name, (dtype, shape) in LEAVES.items()
        }
        return TensorDict(
            {"observation": leaves, "action_mask": self._draw(2) < 0.5}, self.batch_size
        )

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        return self._observe()

    def _step(self, tensordict: Any) -> TensorDict:
        terminated, truncated = self._draw(1) < 0.15, self._draw(1) < 0.15
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return self._observe().update({"reward": self._draw(1), **flags})

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)


@cache
def _play(envs: int | None, steps: int, padding: Any, seed: int) -> TensorDictBase:
    env: Any = SeveralEnv(() if envs is None else (envs,), seed)
    names = [[(group, name) for name in LEAVES] for group in ("observation", "history")]
    for leaf, (_, shape) in zip(range(len(LEAVES)), LEAVES.values(), strict=True):
        keys = [[group[leaf]] for group in names]
        history = History(MOST_FRAMES, *keys, observation_ndim=len(shape), padding=padding)
        env = TransformedEnv(env, history)
    first = steps // 3
    parts = [env.rollout(count, break_when_any_done=False) for count in (first, steps - first)]
    played: Any = torch.cat(parts, -1)
    return played.exclude("done", "terminated", "truncated")


def play_several(
    envs: int | None, steps: int, num_frames: int, padding: Any, seed: int = 0
) -> TensorDictBase:
    """Plays steps [envs, time], or [time] without envs, with histories of all observations.

    After a third, the environments are reset without a flag.
    """
    played = _play(envs, steps, padding, seed).copy()
    for group in (played, played["next"]):
        newest = {}
        for name in LEAVES:  # those of more frames hold those of fewer
            history = group["history", name]
            newest[name] = history.narrow(played.ndim, MOST_FRAMES - num_frames, num_frames)
        group["history"] = TensorDict(newest, played.batch_size)
    return played


def newest(steps: TensorDictBase, time: int, max_size: int) -> TensorDictBase:
    """What a ring holds when steps [envs, T] up to a time were written; [times, envs]."""
    steps = steps if steps.ndim == 1 else steps.transpose(0, 1)
    room = max_size // steps.shape[1:].numel()
    order = [max(range(slot, time, room)) for slot in range(min(time, room))]
    return steps[order]
