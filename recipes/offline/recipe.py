"""What every recipe that trains on a data set has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_tit.datasets.transitions import Gaps

from ..recipe import Recipe, check_at_least
from ..run import Run
from .outcomes import Outcome, summarize


def is_remote(dataset: str) -> bool:
    """Whether a data set is one that has to be downloaded, by D4RL's name."""
    return dataset in D4RL_DATASETS and not Path(dataset).exists()


class OfflineAgent(Protocol):
    """What is trained, and plays the evaluations."""

    def train(self) -> Any:
        """Switches to training mode."""

    def eval(self) -> Any:
        """Switches to evaluation mode."""

    def state_dict(self) -> dict[str, Any]:
        """Returns the weights."""

    def load_state_dict(self, state_dict: dict[str, Any], /) -> Any:
        """Takes weights over."""


AgentT = TypeVar("AgentT", bound=OfflineAgent)


@dataclass(frozen=True, kw_only=True)
class OfflineRecipe(Recipe, Generic[AgentT]):
    """Settings of every recipe that trains on a data set and is evaluated in an environment."""

    offline: ClassVar[bool] = True

    dataset: str
    """A data set: a file in D4RL's layout, or D4RL's or Minari's name."""
    env: str
    """Name of the Gymnasium environment that the network is evaluated in."""
    max_episode_steps: int | None = None
    """Time limit of a data file that does not say where it struck; see docs/datasets.md."""
    gaps: Gaps = "error"
    """What to do where an episode of a data file goes on with another observation than its next
    observation: "error" refuses the data, "cut" ends the episode there."""
    batch_size: int = 64
    """Items of the data set in one gradient step."""
    log_interval: int = 100
    """Gradient steps to a row of metrics."""
    checkpoint_interval: int = 1000
    """Gradient steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            batch_size=1,
            log_interval=1,
            checkpoint_interval=1,
        )
        if self.max_episode_steps is not None:
            check_at_least(self, max_episode_steps=1)

    def reading(self) -> dict[str, Any]:
        """How the data are read: settings of :func:`~torchrl_tit.datasets.load_episodes`."""
        return {"task": self.env, "max_episode_steps": self.max_episode_steps, "gaps": self.gaps}

    def make_agent(self) -> AgentT:
        """Builds what is trained, untrained."""
        raise NotImplementedError

    def play(self, agent: AgentT, step: int) -> list[Outcome]:
        """Plays the evaluation's episodes."""
        raise NotImplementedError

    def evaluation_due(self, step: int) -> bool:
        """Whether the network is evaluated after so many gradient steps."""
        raise NotImplementedError

    def schedule(self, step: int) -> dict[str, float]:
        """What follows a schedule, at the gradient step after so many others."""
        return {}

    def outcome_columns(self) -> dict[float, str]:
        """Names of the metrics that hold the mean return for each target return, if there are."""
        return {}

    def evaluate(self, run: Run) -> dict[str, Any]:
        """Evaluates a run's newest checkpoint; see :func:`~recipes.offline.outcomes.summarize`.

        Episodes that were played with these weights and seeds already are not played again.

        Args:
            run: a run folder with a checkpoint.

        Raises:
            FileNotFoundError: if there is no checkpoint.
        """
        step, agent, state = self.load_agent(run)
        outcomes = [Outcome(**outcome) for outcome in state["outcomes"]]
        targets: list[float | None] = [*self.outcome_columns()] or [None]
        now = [
            outcome
            for outcome in outcomes
            if outcome.step == step
            and state["evaluation_seed"] == self.evaluation_seed
            and len(outcome.returns) == self.evaluation_episodes
            and outcome.target_return in targets
        ]
        if len(now) < len(targets):
            now = self.play(agent, step)
        summary = summarize(now, outcomes, self.dataset, self.env)
        return {**summary, "seed": self.evaluation_seed}

    def load_agent(self, run: Run) -> tuple[int, AgentT, dict[str, Any]]:
        """Loads the agent of a run's newest checkpoint.

        Args:
            run: a run folder with a checkpoint.

        Returns:
            Gradient steps that it was trained for, the agent, and all that the checkpoint holds.

        Raises:
            FileNotFoundError: if there is no checkpoint.
        """
        step, state = run.load_trained()
        torch.set_num_threads(self.threads)
        agent = self.make_agent()
        with run.restoring(step):
            agent.load_state_dict(state["agent"])
        return step, agent, state
