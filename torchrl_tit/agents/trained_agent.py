"""A trained agent, ready to act."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase

_EPISODES = 100


@dataclass(frozen=True, eq=False)
class TrainedAgent:
    """A trained policy, the task that it was trained on, and its transforms.

    Created by :func:`~torchrl_tit.agents.load_agent`.

    Args:
        name: the agent's source.
        policy: a TensorDict module in evaluation mode. It reads the entries that the transforms
            write (for most agents ``"history"``) and writes ``"action"``, a sample or the most
            likely action, according to TorchRL's exploration type.
            :func:`~torchrl_tit.modules.acting` makes it encode each observation once.
        make_env: makes its task with all entries that the policy reads. It takes ``num_envs``,
            ``seed`` and further settings of the task, such as ``render_mode="rgb_array"``; for a
            Decision Transformer, also ``target_return``.
        recipe: the settings of its training run, as in ``recipe.json``.
        steps: the number of steps that it was trained for.
        evaluation: the returns of its episodes, as in ``evaluation.json``; empty for a run whose
            newest checkpoint has not been evaluated.
        versions: versions of the packages that it was trained with, by name.
        plays: plays episodes; :meth:`evaluate` calls it.
    """

    name: str
    policy: TensorDictModuleBase
    make_env: Callable[..., EnvBase]
    recipe: Mapping[str, Any]
    steps: int
    evaluation: Mapping[str, Any]
    versions: Mapping[str, Any]
    plays: Callable[[int, int], Sequence[float]] = field(repr=False)

    @property
    def first_seed(self) -> int:
        """Seed of the first episode of its evaluation; episode i is seeded with this seed + i."""
        return int(self.evaluation.get("seed", self.recipe["evaluation_seed"]))

    def make_transforms(self) -> Compose:
        """Makes the transforms that write the policy's inputs, for your own environment.

        They are those of :attr:`make_env`: histories, the return that a Decision Transformer aims
        for, the state of a recurrent network. Each call makes new ones, because transforms belong
        to one environment.

        Example:
            >>> from torchrl.envs import GymEnv, TransformedEnv
            >>> from torchrl_tit import load_agent
            >>> agent = load_agent("cartpole")
            >>> env = GymEnv("CartPole-v1", categorical_action_encoding=True)
            >>> env = TransformedEnv(env, agent.make_transforms())
            >>> env.rollout(10, agent.policy)["action"].shape
            torch.Size([10])
        """
        with closing(self.make_env(1)) as env:
            transforms = env.transform
            transforms.reset_parent()
        return transforms

    def evaluate(self, episodes: int | None = None, *, seed: int | None = None) -> Tensor:
        """Plays whole episodes with the most likely actions, as the agent's evaluation did.

        Args:
            episodes: number of episodes; by default as many as in its evaluation, or 100.
            seed: seed of the first episode; episode i has ``seed + i``. By default, the seed of its
                evaluation, so that its first episodes are repeated.

        Returns:
            The undiscounted return of each episode; float64 [episodes].

        Raises:
            ValueError: if ``episodes`` is less than 1.

        Example:
            >>> from torchrl_tit import load_agent
            >>> load_agent("cartpole").evaluate(episodes=2).shape
            torch.Size([2])
        """
        if episodes is None:
            episodes = int(self.evaluation.get("episodes", _EPISODES))
        if episodes < 1:
            raise ValueError(f"episodes must be at least 1, not {episodes}")
        returns = self.plays(episodes, self.first_seed if seed is None else seed)
        return torch.tensor(returns, dtype=torch.float64)
