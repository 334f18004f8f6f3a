"""`data collect`: data sets of a task, made the way D4RL's were."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import RandomPolicy
from tqdm import tqdm

from torchrl_tit.datasets import (
    Episodes,
    TaskSpaces,
    TransitionParts,
    load_episodes,
    task_spaces,
    write_hdf5,
    write_minari,
)
from torchrl_tit.envs import make_env
from torchrl_tit.envs.actions import ActionWriter
from torchrl_tit.envs.spaces import ObservationReader
from torchrl_tit.files import remove_leftovers, write_text_atomic
from torchrl_tit.modules import acting

from ...core.algorithm import naming
from ...core.numbers import number
from ...core.recipe import Recipe
from ...core.recipe_json import recipe_to_json
from ...core.run import locked, package_versions
from ...core.task import play_once
from .agents import AgentInTraining, DataAgent, as_fields, find_agent
from .settings import KINDS, Collection, Kind

Policy = Callable[[TensorDictBase], TensorDictBase]
# What episodes need of a step.
_STEP = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "truncated", "done")),
    ("next", "game_over"),
]


def collect(settings: Collection, folder: Path, command: str = "") -> list[str]:
    """Makes data sets in a folder, except those that are there already.

        settings.json             settings, recipe, versions and command
        training/                 the agent's run folder, from which training resumes
        random.hdf5, random-v0/   a data set in D4RL's layout, and the same as a Minari data set
        mixed.hdf5, mixed-v0/ ...

    Work that a killed process finished is not repeated. A training that it cut off goes on from its
    newest checkpoint with new episodes.

    Args:
        settings: what to make.
        folder: the output folder; created if missing.
        command: the command line, which is recorded in the data.

    Returns:
        A line for each set.

    Raises:
        ValueError: if the settings are invalid, the folder holds sets with other settings, or a
            mark is never reached. Sets that were made before are kept.
        FileExistsError: if the folder holds anything else.
        RuntimeError: if another process uses the folder.
        OSError: if something cannot be written.

    Example:
        >>> import tempfile
        >>> settings = Collection(env="CartPole-v1", sets=("random",), transitions=100)
        >>> [line] = collect(settings, Path(tempfile.mkdtemp()))
        >>> line.split(" transitions")[0]
        'random: 1...'
    """
    torch.set_num_threads(settings.threads)
    task = task_spaces(settings.env)
    if not _is_recorded_as_it_is(task):
        raise ValueError(
            f"{settings.env} has observations {task.observation} and actions {task.action}, but "
            "data can be collected of one array or image (a Box of floats or uint8, channels "
            "first) and of a vector (a Box of floats) or one choice (Discrete, from 0)"
        )
    agent = find_agent(settings, folder / "training", task.action)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        remove_leftovers(folder)
        record = _claim(folder, settings, None if agent is None else agent.recipe, command)
        sets = _Sets(settings, folder, task, agent, record)
        return [sets.make(kind) for kind in KINDS if kind in settings.sets]


def _is_recorded_as_it_is(task: TaskSpaces) -> bool:
    """Whether tensordicts hold the task's observations and actions unchanged."""
    if not (isinstance(task.observation, Box) and isinstance(task.action, Box | Discrete)):
        return False
    if task.observation.dtype.kind != "f" and task.observation.dtype != "uint8":
        return False
    try:
        observation = ObservationReader(task.observation).spec
        action = ActionWriter(task.action, clip=False).spec
    except (TypeError, ValueError):  # such as an image of unknown layout
        return False
    return (
        observation.shape == task.observation.shape
        and action.shape == task.action.shape
        and task.action.dtype.kind == ("i" if isinstance(task.action, Discrete) else "f")
        and getattr(task.action, "start", 0) == 0
    )


def _claim(
    folder: Path, settings: Collection, recipe: Recipe | None, command: str
) -> dict[str, Any]:
    """Records the settings in a folder, or checks that they match those recorded there.

    Returns:
        The record: settings, the recipe of the agent (if there is one), versions and command.

    Raises:
        ValueError: if the folder holds sets with other settings.
        FileExistsError: if it holds anything else.
    """
    record: dict[str, Any] = {
        "settings": json.loads(json.dumps(asdict(settings))),
        "recipe": None if recipe is None else json.loads(recipe_to_json(recipe)),
        "versions": package_versions(),
        "command": command,
    }
    path = folder / "settings.json"
    if path.exists():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
            settings_before, recipe_before = dict(before["settings"]), before.get("recipe")
        except (ValueError, LookupError, TypeError) as error:
            raise ValueError(
                f"{path} cannot be read ({error}): name another folder with --out"
            ) from error
        if changes := _changes(folder, settings_before, recipe_before, record, settings):
            raise ValueError(
                f"{folder} holds data of other settings ({'; '.join(changes)}): name another "
                "folder with --out, or move it away"
            )
    elif any(other.name != ".lock" for other in folder.iterdir()):
        raise FileExistsError(
            f"{folder} holds something other than collected data: name another folder with --out"
        )
    write_text_atomic(path, json.dumps(record, indent=2) + "\n")
    return record


def _changes(
    folder: Path,
    before: dict[str, Any],
    recipe_before: dict[str, Any] | None,
    record: dict[str, Any],
    settings: Collection,
) -> list[str]:
    """What differs from the settings that made a folder's data, as far as data depend on it."""
    independent = ("sets", "threads", "total_steps")
    now = {name: value for name, value in record["settings"].items() if name not in independent}
    changes = [f"{k}: {before.get(k)!r} -> {v!r}" for k, v in now.items() if before.get(k) != v]
    # The recipe takes these from the settings, which are compared above.
    adapted = {"seed", "threads", "checkpoint_interval"}
    adapted |= {"total_steps"} if settings.agent == "sac" else set()
    recipes = [
        {name: value for name, value in recipe.items() if name not in adapted}
        for recipe in (recipe_before, record["recipe"])
        if recipe is not None
    ]
    if len(recipes) == 2 and recipes[0] != recipes[1]:
        changes.append(f"the recipe {settings.agent}")
    # Longer training ends with another agent.
    of_the_end = [k for k in KINDS if k != "random" and settings.mark(k)[1] is None]
    made = any((folder / f"{kind}.hdf5").exists() for kind in of_the_end)
    steps = before.get("total_steps", 0)
    if settings.total_steps < steps or (settings.total_steps > steps and made):
        changes.append(f"total_steps: {steps} -> {settings.total_steps}")
    return changes


@dataclass(frozen=True)
class _Sets:
    """The data sets of a folder."""

    settings: Collection
    folder: Path
    task: TaskSpaces
    agent: DataAgent | None
    record: dict[str, Any]

    def make(self, kind: Kind) -> str:
        """Makes a set, or as much of it as is missing; returns a summary."""
        hdf5 = self.folder / f"{kind}.hdf5"
        minari = self.folder.absolute() / f"{kind}-v0"  # Minari requires a version in its names
        parts = TransitionParts(self.folder / f"{kind}.parts")
        if not hdf5.exists():
            write_hdf5(
                self._random(parts) if kind == "random" else self._of_agent(kind, parts), hdf5
            )
        episodes = load_episodes(hdf5, task=self.task, dtype=None)
        if not minari.exists():
            write_minari(episodes, minari, self.settings.env)
        shutil.rmtree(parts.folder)
        whole = episodes.returns[episodes.is_whole]
        mean = number(whole.mean().item()) if len(whole) else "unknown"
        return (
            f"{kind}: {episodes.num_transitions} transitions in {len(episodes.lengths)} episodes, "
            f"mean return of whole ones {mean}: {hdf5} and {minari.name}"
        )

    def _random(self, parts: TransitionParts) -> Episodes:
        """Episodes with uniformly drawn actions."""
        env = make_env(self.settings.env, self.settings.num_envs, clip_actions=False)
        episodes = self._play(env, RandomPolicy(env.action_spec), "random", parts)
        return self._with_origin(episodes, "random", "uniform actions", {})

    def _of_agent(self, kind: Kind, parts: TransitionParts) -> Episodes:
        """The transitions of training up to the set's mark, or episodes played at the mark."""
        agent, (name, mark) = self.agent, self.settings.mark(kind)
        assert agent is not None
        score = agent.reach(name, mark)
        if kind == "expert" and "medium" in self.settings.sets:
            medium = agent.reach(*self.settings.mark("medium"))
            if medium.step == score.step:
                warnings.warn(
                    f"medium and expert are the same agent: after {score.step} steps, its mean "
                    f"return, {number(score.mean)}, reaches both marks; move them apart",
                    stacklevel=2,
                )
        if kind == "mixed":
            assert isinstance(agent, AgentInTraining)  # a finished run was rejected earlier
            episodes = agent.parts.episodes(score.step, task=self.task)
        else:
            env = agent.algorithm.make_env(self.settings.num_envs)
            episodes = self._play(env, agent.load_policy(score), kind, parts)
        origin = {
            "recipe": json.dumps(self.record["recipe"]),
            "agent": self.settings.agent,
            "agent_steps": score.step,
            "agent_return": score.mean,
            "agent_return_std": score.std,
            **({} if mark is None else {name: mark}),
        }
        return self._with_origin(episodes, kind, agent.recipe.algorithm.upper(), origin)

    def _play(self, env: EnvBase, policy: Policy, kind: Kind, parts: TransitionParts) -> Episodes:
        """Plays episodes of a policy that no longer learns; closes the environment."""
        seed = np.random.SeedSequence([self.settings.seed, KINDS.index(kind)]).generate_state(1)
        with closing(env), naming(f"in {self.settings.env}"):
            play_episodes(parts, env, policy, self.settings, self.task, int(seed[0]))
        return parts.episodes(task=self.task)

    def _with_origin(
        self, episodes: Episodes, kind: Kind, algorithm: str, origin: dict[str, Any]
    ) -> Episodes:
        """The episodes, with what they came from as attributes."""
        env = self.settings.env
        attributes = {
            "kind": kind,
            "algorithm": algorithm,
            "description": (
                f"{kind} data of {env}: {episodes.num_transitions} transitions in "
                f"{len(episodes.lengths)} episodes, {algorithm}"
            ),
            "env_id": env,
            "seed": self.settings.seed,
            "command": self.record["command"],
            "settings": json.dumps(self.record["settings"]),
            "versions": json.dumps(self.record["versions"]),
        }
        return replace(episodes, attributes={**attributes, **origin})


def play_episodes(
    parts: TransitionParts,
    env: EnvBase,
    policy: Policy,
    settings: Collection,
    task: TaskSpaces,
    seed: int,
) -> None:
    """Plays episodes until the parts hold enough transitions; the last episode is complete.

    Each part holds one episode of every environment, started together. Short episodes are therefore
    not favored, and a part depends only on its number and the seed, not on earlier parts, so that
    a resumed process plays none again. A single episode that is longer than the set is cut off.

    Args:
        parts: where the episodes are written; existing ones count.
        env: environments [N], which are reset with seeds.
        policy: writes the action into the tensordict that it is given.
        settings: the number of transitions, and whether actions are sampled.
        task: the task; actions are recorded as it receives them, clipped to its bounds.
        seed: seed of all episodes.

    Raises:
        FloatingPointError: if a reward of these episodes is NaN or infinite.
    """
    remove_leftovers(parts.folder)
    total, number, rows = settings.transitions, len(parts.numbers()), parts.num_rows()
    kind = ExplorationType.DETERMINISTIC if settings.deterministic else ExplorationType.RANDOM
    bar = {"initial": min(rows, total), "unit": " transitions", "desc": parts.folder.stem}
    with torch.no_grad(), set_exploration_type(kind), tqdm(total=total, **bar) as progress:
        while rows < total:
            state = np.random.SeedSequence([seed, number]).generate_state(2)
            torch.manual_seed(int(state[0]))
            with acting(policy):  # discards the frames of the previous part
                episodes = _play(env, policy, task, int(state[1]) >> 1, total)
            chosen: list[dict[str, NDArray]] = []
            while episodes and rows < total:
                chosen.append(episodes.pop(0))
                rows += len(chosen[-1]["rewards"])
            joined = {name: np.concatenate([e[name] for e in chosen])[None] for name in chosen[0]}
            parts.write(number, joined)
            number += 1
            progress.update(min(rows, total) - progress.n)


def _play(
    env: EnvBase, policy: Policy, task: TaskSpaces, seed: int, max_steps: int
) -> list[dict[str, NDArray]]:
    """Plays an episode or a whole game in each environment; returns D4RL's fields of each."""
    steps, lengths = play_once(env, policy, _STEP, seed=seed, max_steps=max_steps)
    fields = as_fields(steps, task.action)
    episodes = []
    for index, length in enumerate(lengths):
        episode = {name: values[index, :length].numpy() for name, values in fields.items()}
        if length < max_steps:  # otherwise it may be going on, and is cut off
            episode["timeouts"][-1] |= not episode["terminals"][-1]
        episodes.append(episode)
    return episodes
