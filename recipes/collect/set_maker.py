"""Makes data sets one after another, each as an HDF5 file and as a Minari data set."""

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

from ..algorithm import naming
from .agent import Agent, Score
from .agent_in_training import AgentInTraining
from .episodes import play_episodes
from .output_folder import hdf5_path
from .settings import KINDS, Collection, Kind


class SetMaker:
    """Makes the data sets of a folder.

    Args:
        settings: what to make.
        folder: the output folder.
        task: the task's spaces.
        agent: the agent; None if only random actions are needed.
        provenance: the provenance that every set records.
    """

    def __init__(
        self,
        settings: Collection,
        folder: Path,
        task: TaskSpaces,
        agent: Agent | None,
        provenance: dict[str, Any],
    ) -> None:
        self._settings = settings
        self._folder = folder
        self._task = task
        self._agent = agent
        self._provenance = provenance

    def make(self, kind: Kind) -> str:
        """Makes a set, or as much of it as is missing.

        Args:
            kind: the kind of data.

        Returns:
            A summary of the set.
        """
        hdf5 = hdf5_path(self._folder, kind)
        minari = self._folder.absolute() / f"{kind}-v0"  # Minari requires a version in its names
        parts = self._folder / f"{kind}.parts"
        if not hdf5.exists():
            episodes = self._random(parts) if kind == "random" else self._of_agent(kind, parts)
            write_hdf5(episodes, hdf5)
        episodes = load_episodes(hdf5, task=self._task, dtype=None)
        if not minari.exists():
            write_minari(episodes, minari, self._settings.env)
        shutil.rmtree(parts, ignore_errors=True)
        return (
            f"{kind}: {episodes.num_transitions} transitions in {len(episodes.lengths)} episodes, "
            f"mean return {episodes.returns.mean():.1f}: {hdf5} and {minari.name}"
        )

    def _random(self, folder: Path) -> Episodes:
        """Episodes with uniformly drawn actions."""
        env = make_env(self._settings.env, self._settings.num_envs, clip_actions=False)
        episodes = self._play(env, RandomPolicy(env.action_spec), "random", folder)
        return self._with_provenance(episodes, "random", "uniform actions")

    def _of_agent(self, kind: Kind, folder: Path) -> Episodes:
        """The transitions of training up to the set's mark, or episodes played at the mark."""
        agent = self._agent
        assert agent is not None
        score = agent.reach(*self._settings.mark(kind))
        if kind == "mixed":
            assert isinstance(agent, AgentInTraining)  # a finished run was rejected earlier
            episodes = agent.parts.episodes(score.step, task=self._task)
        else:
            env = agent.algorithm.make_env(self._settings.num_envs)
            episodes = self._play(env, agent.load_policy(score), kind, folder)
        return self._with_provenance(episodes, kind, agent.recipe.algorithm.upper(), score)

    def _play(
        self,
        env: EnvBase,
        policy: Callable[[TensorDictBase], TensorDictBase],
        kind: Kind,
        folder: Path,
    ) -> Episodes:
        """Plays episodes of a policy that no longer learns; closes the environment."""
        settings, parts = self._settings, TransitionParts(folder)
        seed = np.random.SeedSequence([settings.seed, KINDS.index(kind)]).generate_state(1)
        with closing(env), naming(f"in {settings.env}"):
            play_episodes(
                parts,
                env,
                policy,
                settings.transitions,
                action_space=self._task.action,
                seed=int(seed[0]),
                deterministic=settings.deterministic,
            )
        return parts.episodes(task=self._task)

    def _with_provenance(
        self, episodes: Episodes, kind: Kind, algorithm: str, score: Score | None = None
    ) -> Episodes:
        """The episodes, with their provenance as attributes."""
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
            attributes.pop("recipe", None)  # the agent's, which made the other sets
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
