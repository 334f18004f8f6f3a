"""Agents whose data are collected."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_tit.evaluation import evaluate

from ..algorithm import Algorithm, naming
from ..recipe import Recipe
from ..run import Run
from ..runner import load_trained
from .settings import Collection

# Far from the seeds of training and of the episodes that are collected.
_EVALUATION_SEED = 1_000_000


@dataclass(frozen=True)
class Score:
    """Result of an evaluation of an agent."""

    step: int
    """Environment steps that the agent was trained for."""
    mean: float
    """Mean return of the episodes, with actions taken as in the data."""
    std: float
    """Standard deviation of their returns (population)."""


class Agent(ABC):
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

    @abstractmethod
    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """Loads the policy that had a score returned by :meth:`reach`, in evaluation mode."""

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


class FinishedRun(Agent):
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
        recipe = replace(run.recipe, threads=settings.threads)
        self._step, algorithm, _ = load_trained(run, recipe)
        super().__init__(algorithm, settings)

    def reach(self, name: str, mark: float | None) -> Score:
        """Evaluates the agent."""
        score = self.score(self.algorithm.policy, self._step)
        if mark is not None and score.mean < mark:
            raise ValueError(
                f"{name} {mark:g} is not reached by the run in {self.settings.agent}: its agent "
                f"has a mean return of {score.mean:.1f} after {self._step} steps"
            )
        return score

    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """Returns the run's policy."""
        return self.algorithm.policy
