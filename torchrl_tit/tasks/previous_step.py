"""What the agent did and what it got for it, beside what it sees."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs


class PreviousStep(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds the previous action and the previous reward to what the agent observes.

    Agents with a memory often read them, as in RL² (Duan et al., arXiv 1611.02779). They are added
    to the observations of a task that has several; else they and "observation" become such. Each
    has a frame encoder of its own.

    ===================  ==================  =======================================================
    observation          space               before an episode's first step
    ===================  ==================  =======================================================
    ``previous_action``  Box, float32 [A]    zeros; an action is flattened as by `spaces.flatten`:
                                             one of n actions is one-hot, with A = n
    ``previous_reward``  Box, float32 [1]    zero
    ===================  ==================  =======================================================

    Args:
        env: the task.

    Raises:
        ValueError: if an action has no fixed size, or the task has an observation of these names.

    Example:
        >>> import gymnasium
        >>> env = PreviousStep(gymnasium.make("CartPole-v1"))
        >>> env.reset()[0]["previous_action"], env.step(1)[0]["previous_action"]
        (array([0., 0.], dtype=float32), array([0., 1.], dtype=float32))

        >>> from torchrl_tit.envs import make_env
        >>> wrappers = ["torchrl_tit.tasks:PreviousStep"]
        >>> make_env("CartPole-v1", num_frames=4, wrappers=wrappers).reset()["history"].shape
        torch.Size([1])
    """

    def __init__(self, env: gymnasium.Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        try:
            self._actions = spaces.flatdim(env.action_space)
        except (NotImplementedError, ValueError) as error:
            raise ValueError(
                f"PreviousStep cannot observe actions of {env.action_space}"
            ) from error
        added = {"previous_action": _box(self._actions), "previous_reward": _box(1)}
        named = self._named(env.observation_space)
        if twice := added.keys() & named.keys():
            raise ValueError(f"the task already has an observation {min(twice)!r}")
        self.observation_space = spaces.Dict({**named, **added})

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Begins an episode, in which nothing was done yet."""
        observation, info = super().reset(seed=seed, options=options)
        return self._add(observation, np.zeros(self._actions), 0.0), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict]:
        """Takes an action, which is observed with its reward."""
        observation, reward, terminated, truncated, info = super().step(action)
        taken = spaces.flatten(self.env.action_space, action)
        return self._add(observation, taken, reward), reward, terminated, truncated, info

    def _named(self, seen: Any) -> Any:
        """The observations by name, or their spaces."""
        several = isinstance(self.env.observation_space, spaces.Dict)
        return seen if several else {"observation": seen}

    def _add(self, seen: Any, action: Any, reward: SupportsFloat) -> dict[str, Any]:
        added = {
            "previous_action": np.asarray(action, np.float32),
            "previous_reward": np.array([float(reward)], np.float32),
        }
        return {**self._named(seen), **added}


def _box(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)
