"""One data set after the other, each written as HDF5 and for Minari."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.modules import RandomPolicy

from torchrl_tit.datasets import (
    Episodes,
    TaskSpaces,
    TransitionParts,
    load_episodes,
    write_hdf5,
    write_minari,
)
from torchrl_tit.envs import make_env

from .agents import FinishedRun, Source
from .folder import hdf5_path, minari_path
from .rollout import roll_out
from .settings import KINDS, Collection, Kind
from .training import Score, Training


class SetMaker:
    """Makes the data sets of a folder.

    Args:
        settings: what to make.
        folder: where.
        task: the task's spaces.
        agent: where the agent comes from; None where only random actions are asked for.
        provenance: what every set says about where it is from.
    """

    def __init__(
        self,
        settings: Collection,
        folder: Path,
        task: TaskSpaces,
        agent: Source | None,
        provenance: dict[str, Any],
    ) -> None:
        self._settings = settings
        self._folder = folder
        self._task = task
        self._provenance = provenance
        self._agent: Training | FinishedRun | None
        if agent is None or isinstance(agent, FinishedRun):
            self._agent = agent
        else:
            marks = (settings.medium_return, settings.expert_return)
            self._agent = Training(
                folder / "training",
                agent,
                task.action,
                marks=[mark for mark in marks if mark is not None],
                evaluation_interval=settings.evaluation_interval,
                evaluation_episodes=settings.evaluation_episodes,
                deterministic=settings.deterministic,
            )

    def make(self, kind: Kind) -> str:
        """Makes a set, or as much of it as is not there yet.

        Args:
            kind: the kind of data.

        Returns:
            What is there now, in words.
        """
        hdf5, minari = hdf5_path(self._folder, kind), minari_path(self._folder, kind)
        rolled = self._folder / f"{kind}.parts"
        if not hdf5.exists():
            episodes = self._see(kind) if kind == "mixed" else self._roll(kind, rolled)
            write_hdf5(episodes, hdf5)
        episodes = load_episodes(hdf5, task=self._task, dtype=None)
        if not minari.exists():
            write_minari(episodes, minari, self._settings.env)
        shutil.rmtree(rolled, ignore_errors=True)
        return (
            f"{kind}: {episodes.num_transitions} transitions in {len(episodes.lengths)} episodes, "
            f"mean return {episodes.returns.mean():.1f}: {hdf5} and {minari.name}"
        )

    def _see(self, kind: Kind) -> Episodes:
        """What the agent saw on its way to the mark."""
        agent, score = self._trained(kind)
        assert isinstance(agent, Training)
        episodes = agent.parts.episodes(score.step, task=self._task)
        return self._signed(episodes, kind, agent.algorithm, score)

    def _roll(self, kind: Kind, folder: Path) -> Episodes:
        """What a policy does that learns no more."""
        policy: Callable[[TensorDictBase], TensorDictBase]
        settings = self._settings
        if kind == "random":
            algorithm, score = "uniform actions", None
            env: EnvBase = make_env(settings.env, settings.num_envs, clip_actions=False)
            policy = RandomPolicy(env.action_spec)
        else:
            agent, score = self._trained(kind)
            algorithm = agent.algorithm
            env = agent.make_env(settings.num_envs, 0)
            policy = agent.load_policy(score)
        parts = TransitionParts(folder)
        seed = np.random.SeedSequence([settings.seed, KINDS.index(kind)]).generate_state(1)
        with closing(env):
            roll_out(
                parts,
                env,
                policy,
                settings.transitions,
                action_space=self._task.action,
                seed=int(seed[0]),
                deterministic=settings.deterministic,
            )
        return self._signed(parts.episodes(task=self._task), kind, algorithm, score)

    def _trained(self, kind: Kind) -> tuple[Training | FinishedRun, Score]:
        """The agent, trained until it reached the mark of a kind of data."""
        assert self._agent is not None
        return self._agent, self._agent.reach(*self._settings.mark(kind))

    def _signed(
        self, episodes: Episodes, kind: Kind, algorithm: str, score: Score | None
    ) -> Episodes:
        """The episodes with their provenance."""
        attributes: dict[str, Any] = {
            "kind": kind,
            "algorithm": algorithm,
            "description": (
                f"{kind} data of {self._settings.env}: {episodes.num_transitions} transitions in "
                f"{len(episodes.lengths)} episodes, {algorithm}"
            ),
            **self._provenance,
        }
        if score is None:
            attributes.pop("recipe", None)  # that of the other sets
        else:
            name, mark = self._settings.mark(kind)
            attributes |= {
                "agent": self._settings.agent,
                "agent_steps": score.step,
                "agent_return": score.mean,
                "agent_return_std": score.std,
                **({} if mark is None else {name: mark}),
            }
        return replace(episodes, attributes=attributes)
