"""Agents whose data are collected: finished runs, and agents that are trained for their data."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from gymnasium import Space
from gymnasium.spaces import Box
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint, save_checkpoint
from torchrl_tit.datasets import TransitionParts
from torchrl_tit.evaluation import evaluate
from torchrl_tit.files import write_text_atomic
from torchrl_tit.settings.networks import mlp

from ...core.algorithm import Algorithm, make_algorithm, naming
from ...core.callback import Callback
from ...core.numbers import number
from ...core.recipe import Recipe
from ...core.recipe_json import recipe_to_json
from ...core.registry import find_recipe
from ...core.run import Run
from ...core.runner import load_trained, train
from ...sac import SAC
from .settings import Collection

# Far from the seeds of training and of the episodes that are collected.
_EVALUATION_SEED = 1_000_000
# Environment steps per file of transitions; a checkpoint also ends a file.
_STEPS_PER_PART = 1000
# Fields of a recipe that change the observations, actions or rewards of the task.
_CHANGES = ("env_settings", "wrappers", "observation_keys")


@dataclass(frozen=True)
class Score:
    """Result of an evaluation of an agent."""

    step: int
    """Environment steps that the agent was trained for."""
    mean: float
    """Mean return of the episodes, with actions taken as in the data."""
    std: float
    """Standard deviation of their returns (population)."""


class DataAgent(ABC):
    """An agent that reaches marks, and then plays episodes for a data set.

    Args:
        algorithm: the recipe's algorithm.
        settings: the settings of the collection.
    """

    def __init__(self, algorithm: Algorithm[Any], settings: Collection) -> None:
        self.algorithm = algorithm
        self.recipe: Recipe = algorithm.recipe
        self.settings = settings

    @abstractmethod
    def reach(self, name: str, mark: float | None) -> Score:
        """Brings the agent to a mark.

        Args:
            name: the mark's name, for messages.
            mark: a mean return; the end of the training if None.

        Returns:
            The first score that reached it.

        Raises:
            ValueError: if the mark is not reached.
        """

    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """Loads the policy that had a score returned by :meth:`reach`, in evaluation mode."""
        return self.algorithm.policy

    def score(self, policy: TensorDictModuleBase, step: int) -> Score:
        """Evaluates a policy that was trained for a number of environment steps."""
        with naming(f"in {self.recipe.env}, in the evaluation at step {step}"):
            returns = evaluate(
                self.algorithm.make_env,
                policy,
                self.settings.evaluation_episodes,
                seed=_EVALUATION_SEED,
                deterministic=self.settings.deterministic,
            )
        return Score(step, returns.mean().item(), returns.std(correction=0).item())


class FinishedRun(DataAgent):
    """The newest checkpoint of a run: an agent without the data that it was trained on.

    Args:
        run: the run.
        settings: the settings of the collection.

    Raises:
        ValueError: if a mixed set is requested, or the checkpoint does not fit the recipe.
        FileNotFoundError: if there is no checkpoint.
    """

    def __init__(self, run: Run, settings: Collection) -> None:
        if "mixed" in settings.sets:
            raise ValueError(
                f"the run in {run.folder} has not kept what it saw, so there is no mixed set: "
                "leave that out with --sets, or train a recipe with --agent"
            )
        self._step, algorithm, _ = load_trained(run, replace(run.recipe, threads=settings.threads))
        super().__init__(algorithm, settings)

    def reach(self, name: str, mark: float | None) -> Score:
        """Evaluates the agent."""
        score = self.score(self.algorithm.policy, self._step)
        if mark is not None and score.mean < mark:
            raise ValueError(
                f"{name} {mark:g} is not reached by the run in {self.settings.agent}: its agent "
                f"has a mean return of {number(score.mean)} after {self._step} steps"
            )
        return score


class AgentInTraining(DataAgent, Callback):
    """An agent that is trained from mark to mark, in a run folder from which it is resumed.

        recipe.json, checkpoints/, ...   those of any run
        evaluations.json                 scores of the agent
        agents/                          its weights at each mark
        seen/                            all transitions, in parts

    It is the callback of its own training: it keeps the transitions, evaluates the policy, and ends
    the training when a mark is reached for the first time.

    Args:
        algorithm: the recipe's algorithm, for environments and policies.
        settings: the settings of the collection.
        folder: the folder; created if missing.
        action_space: action space of the task.
    """

    def __init__(
        self, algorithm: Algorithm[Any], settings: Collection, folder: Path, action_space: Space
    ) -> None:
        super().__init__(algorithm, settings)
        self.last_step: int = min(self.recipe.final_step, settings.total_steps)
        self._folder = folder
        self._action_space = action_space
        marks = (settings.medium_return, settings.expert_return)
        self._marks = [mark for mark in marks if mark is not None]
        self._step = 0
        self._scores: list[Score] = []
        self._pending: list[dict[str, Tensor]] = []  # transitions that are not written yet

    @property
    def parts(self) -> TransitionParts:
        """All transitions up to the newest checkpoint, numbered by step."""
        return TransitionParts(self._folder / "seen")

    def reach(self, name: str, mark: float | None) -> Score:
        """Trains from the newest checkpoint until the mark is reached, unless it already was."""
        self._load()
        while (score := self._first(mark)) is None:
            if self._step >= self.last_step:
                raise ValueError(self._why_never(name, mark))
            write_text_atomic(self._folder / "recipe.json", recipe_to_json(self.recipe))
            with Run(self._folder, self.recipe) as run:
                train(self.recipe, run, [self])
            self._load()
        return score

    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """Loads the weights that were saved at a mark."""
        _, weights = load_checkpoint(self._folder / "agents", score.step)
        self.algorithm.policy.load_state_dict(weights)
        return self.algorithm.policy.eval()

    def collected(self, step: int, batch: TensorDictBase) -> None:
        """Keeps the transitions."""
        fields = as_fields(batch, self._action_space)
        self._pending.append({name: tensor.clone() for name, tensor in fields.items()})
        if sum(part["rewards"].numel() for part in self._pending) >= _STEPS_PER_PART:
            self.saving(step)

    def saving(self, step: int) -> None:
        """Writes the transitions that were seen before a checkpoint."""
        if self._pending:
            names = self._pending[0]
            fields = {n: torch.cat([part[n] for part in self._pending], 1) for n in names}
            self.parts.write(step, {name: tensor.numpy() for name, tensor in fields.items()})
            self._pending = []

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        """Evaluates the policy if due; returns whether it reaches a mark for the first time."""
        before, self._step = self._step, step
        interval = self.settings.evaluation_interval
        ends = step >= self.last_step
        if not ends and (not self._marks or step // interval == before // interval):
            return False
        score = self.score(policy, step)
        self._scores.append(score)
        scores = json.dumps([asdict(score) for score in self._scores], indent=2) + "\n"
        write_text_atomic(self._folder / "evaluations.json", scores)
        if not ends and all(self._first(mark) is not score for mark in self._marks):
            return False
        # All are kept: at most one for each mark, and one for each final step that was set.
        save_checkpoint(self._folder / "agents", step, policy.state_dict(), keep=step)
        return True

    def _first(self, mark: float | None) -> Score | None:
        """The first score that reached a mark, or the one at the end of training."""
        reached = (
            s.step >= self.last_step if mark is None else s.mean >= mark for s in self._scores
        )
        return next((score for score, ok in zip(self._scores, reached, strict=True) if ok), None)

    def _load(self) -> None:
        """Reads the state of the newest checkpoint; later work is repeated."""
        self._step = max(checkpoint_steps(self._folder / "checkpoints"), default=0)
        path = self._folder / "evaluations.json"
        scores = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
        self._scores = [Score(**score) for score in scores if score["step"] <= self._step]
        self._pending = []
        self.parts.drop_after(self._step)

    def _why_never(self, name: str, mark: float | None) -> str:
        if mark is None or not self._scores:
            return (
                f"{self._folder / 'evaluations.json'} lacks the evaluations: delete {self._folder} "
                "to train again"
            )
        best = max(score.mean for score in self._scores)
        return (
            f"{name} {mark:g} was never reached in {self._step} steps: the best of "
            f"{len(self._scores)} evaluations had a mean return of {number(best)}. Raise "
            "total_steps, and the same command resumes; or choose another mark and another folder"
        )


def find_agent(settings: Collection, folder: Path, action_space: Space) -> DataAgent | None:
    """Finds the agent that the settings name, and checks that it fits the task.

    Args:
        settings: the settings of the collection.
        folder: where an agent is trained; not touched here.
        action_space: action space of the task.

    Returns:
        The agent; None if no set needs one.

    Raises:
        ValueError: if there is no such agent, or it does not fit the task or the sets.
        FileNotFoundError: if it is a run without a checkpoint, or a JSON file that does not exist.
    """
    if set(settings.sets) == {"random"}:
        return None
    if (Path(settings.agent) / "recipe.json").is_file():
        run = Run.open(Path(settings.agent))
        _check(run.recipe, settings.env)
        return FinishedRun(run, settings)
    recipe: Recipe
    if settings.agent == "sac":  # with the networks of the agents that made D4RL's data
        backbone, steps = mlp(hidden_dim=256, activation="relu"), settings.total_steps
        recipe = SAC(name="sac", env=settings.env, backbone=backbone, total_steps=steps)
    else:
        recipe = find_recipe(settings.agent)
    _check(recipe, settings.env)
    # With several collectors, a batch does not continue the one before.
    changes: dict[str, Any] = {
        "collectors": 1,
        "ray": None,
        **{name: getattr(settings, name) for name in ("seed", "threads", "checkpoint_interval")},
    }
    names = {field.name for field in fields(recipe)}
    recipe = replace(recipe, **{name: x for name, x in changes.items() if name in names})
    algorithm = make_algorithm(recipe)
    algorithm.check()
    return AgentInTraining(algorithm, settings, folder, action_space)


def _check(recipe: Recipe, env: str) -> None:
    """Raises ValueError if a recipe cannot produce the data of a task."""
    problem = None
    if recipe.offline:
        problem = "is trained on a data set, not in its task"
    elif recipe.algorithm == "dqn":
        problem = "is of dqn, whose policy has no distribution to sample actions from"
    elif recipe.env != env:
        problem = f"is of the task {recipe.env}, not {env}"
    elif getattr(recipe, "hide_velocities", False):
        problem = "hides the velocities, which the data should have"
    elif changed := [name for name in _CHANGES if getattr(recipe, name)]:
        problem = f"changes the task with {' and '.join(changed)}, so its data are of another"
    if problem:
        name = recipe.name or f"of {recipe.algorithm}"
        raise ValueError(
            f"the recipe {name} {problem}: choose sac, or another ppo or sac recipe, with --agent"
        )


def as_fields(batch: TensorDictBase, action_space: Space) -> dict[str, Tensor]:
    """Converts steps of an environment to D4RL's fields, on the CPU.

    Args:
        batch: steps, of any shape [...].
        action_space: action space of the task; actions that a Gaussian policy sampled beyond its
            bounds are clipped to them.

    Returns:
        Tensors [...]; observations [..., *obs] and actions [..., *action].
    """
    outcome, actions = batch["next"], batch["action"].cpu()
    if isinstance(action_space, Box):
        low, high = (torch.from_numpy(bound) for bound in (action_space.low, action_space.high))
        actions = actions.clamp(low, high)
    fields = {
        "observations": batch["observation"],
        "actions": actions,
        "rewards": outcome["reward"].squeeze(-1),
        "terminals": outcome["terminated"].squeeze(-1),
        "timeouts": outcome["truncated"].squeeze(-1),
        "next_observations": outcome["observation"],
    }
    return {name: tensor.cpu() for name, tensor in fields.items()}
