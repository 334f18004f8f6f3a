"""Trained agents by name, from a folder, or from the Hugging Face Hub."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase

from torchrl_tit.agents.acting import Actor, parts_of
from torchrl_tit.agents.folder import AgentError, is_agent, read_agent
from torchrl_tit.agents.hub import PREFIX, download
from torchrl_tit.settings import resolve
from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.choices import Device

_PACKAGED = Path(__file__).parent
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

    @cached_property
    def _actor(self) -> Actor:
        return Actor(self.policy, self.make_env)

    def reset(self, which: Any = None) -> None:
        """Begins an episode with the next observation of :meth:`act`.

        Args:
            which: in which of several copies, bool [N]; all by default.
        """
        self._actor.reset(which)

    def act(self, observation: Any, *, reward: Any = 0.0, action_mask: Any = None) -> NDArray:
        """Returns the most likely action for an observation of a machine, as NumPy arrays.

        Histories, recurrent states and missing frames are kept inside; call :meth:`reset` where an
        episode begins. See :meth:`torchrl_tit.agents.acting.Actor.act` for the arguments.

        Example:
            >>> import gymnasium
            >>> from torchrl_tit import load_agent
            >>> agent, env = load_agent("cartpole"), gymnasium.make("CartPole-v1")
            >>> observation, info = env.reset(seed=0)
            >>> agent.reset()
            >>> agent.act(observation) in env.action_space
            True
        """
        return self._actor.act(observation, reward=reward, action_mask=action_mask)

    @property
    def first_seed(self) -> int:
        """Seed of the first episode of its evaluation; episode i is seeded with this seed + i."""
        return int(self.evaluation.get("seed", self.recipe["evaluation_seed"]))

    def make_transforms(self) -> Compose:
        """Makes the transforms that write the policy's inputs, for your own environment.

        They are those of :attr:`make_env`: histories, the return that a Decision Transformer aims
        for, the state of a recurrent network. Each call makes new ones, because transforms belong
        to one environment. They do not clip continuous actions to their bounds, which the task of
        :attr:`make_env` does: a Gaussian policy needs `ClipAction` of Gymnasium there.

        Example:
            >>> from torchrl.envs import GymEnv, TransformedEnv
            >>> from torchrl_tit import load_agent
            >>> agent = load_agent("cartpole")
            >>> env = GymEnv("CartPole-v1", categorical_action_encoding=True)
            >>> env = TransformedEnv(env, agent.make_transforms())
            >>> env.rollout(10, agent.policy)["action"].shape
            torch.Size([10])
        """
        return parts_of(self.make_env)[1]

    def evaluate(self, episodes: int | None = None, *, seed: int | None = None) -> Tensor:
        """Plays whole episodes with the most likely actions, as the agent's evaluation did.

        Args:
            episodes: number of episodes; by default as many as in its evaluation, or 100.
            seed: seed of the first episode; episode i has ``seed + i``. By default, the seed of its
                evaluation, so that its first episodes are repeated.

        Returns:
            The undiscounted return of each episode; float64 [episodes].

        Raises:
            ValueError: if ``episodes`` is less than 1, or it was trained without an environment.

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


def agent_names() -> list[str]:
    """Lists the agents that come with this package.

    Example:
        >>> "cartpole" in agent_names()
        True
    """
    return sorted(path.name for path in _PACKAGED.iterdir() if is_agent(path))


def load_agent(
    source: str | os.PathLike[str], *, device: Device = "cpu", best: bool = False
) -> TrainedAgent:
    """Loads a trained agent. Nothing in its files is executed.

    Args:
        source: the name of an agent that comes with this package (:func:`agent_names`); the folder
            of an agent; a run folder of ``train``, whose newest checkpoint is loaded; or
            ``"hf:user/name"``, a repository of the Hugging Face Hub, where
            ``"hf:user/name@revision"`` names a branch, a tag or a commit.
        device: device of the policy and of the environments; ``"auto"`` is the GPU if there is one.
        best: whether to load a run's best weights instead of its last ones, as ``evaluate --best``
            does; it then plays new episodes.

    Returns:
        The policy, its task and its transforms.

    Raises:
        AgentError: if there is no such agent, one of its files was changed after it was written,
            its weights do not fit its recipe, or ``best`` is set for an agent, which has one set.
        FileNotFoundError: if the run has no checkpoint.
        ValueError: if the run has no best weights yet, or its task or a part of its network cannot
            be built here, for example because a package is missing, or because the user did not
            import a module that the recipe names.

    Example:
        >>> agent = load_agent("cartpole")
        >>> env = agent.make_env(8, seed=0)
        >>> env.rollout(20, agent.policy, break_when_any_done=False)["action"].shape
        torch.Size([8, 20])
        >>> load_agent("cart-pole")
        Traceback (most recent call last):
        ...
        torchrl_tit.agents.folder.AgentError: there is no agent or folder 'cart-pole': did you...
    """
    folder = find_agent(source)
    if is_agent(folder):
        if best:
            raise AgentError(f"{source} is an agent, with one set of weights: leave out best")
        return _recipes("agent_from_files")(read_agent(folder), str(source), device)
    return _recipes("agent_from_run")(folder, device, best=best)


def find_agent(source: str | os.PathLike[str]) -> Path:
    """Finds the folder of an agent or of a run, and downloads it if it is on the Hub.

    Args:
        source: see :func:`load_agent`.

    Raises:
        AgentError: if there is no such agent.

    Example:
        >>> find_agent("cartpole").name
        'cartpole'
    """
    name, folder = os.fspath(source), Path(source)
    if name.startswith(PREFIX):
        return download(name)
    names = agent_names()
    if name in names:
        return _PACKAGED / name
    if not folder.is_dir():
        raise AgentError(
            f"there is no agent or folder {name!r}: "
            f"{nearest(name, names) if names else 'this package holds no agents'}"
        )
    if not is_agent(folder) and not (folder / "recipe.json").is_file():
        raise AgentError(
            f"{folder} is neither an agent nor a run: it holds no agent.json and no recipe.json"
        )
    return folder


def _recipes(name: str) -> Any:
    """Returns a function of the recipes package, which builds networks and tasks from recipes.

    It is found by name, because this library does not depend on that package, which comes with it.
    """
    if importlib.util.find_spec("torchrl_tit.recipes") is None:  # a clone that is not installed
        importlib.import_module("recipes")  # available under both names once imported
    return resolve(f"torchrl_tit.recipes.tools.agents:{name}")
