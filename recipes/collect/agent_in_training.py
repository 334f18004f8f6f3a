"""An agent that is trained until it reaches a mark, and all transitions that it sees until then."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from gymnasium import Space
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint, save_checkpoint
from torchrl_tit.datasets import TransitionParts
from torchrl_tit.files import write_text_atomic

from ..algorithm import Algorithm
from ..callback import Callback
from ..recipe_json import recipe_to_json
from ..run import Run
from ..runner import train
from .agent import Agent, Score
from .episodes import as_fields
from .settings import Collection

# Environment steps per file of transitions; a checkpoint also ends a file.
_STEPS_PER_PART = 1000


class AgentInTraining(Agent, Callback):
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
        self.final_step = min(self.recipe.final_step, settings.total_steps)
        """Environment steps after which training ends."""
        self.last_step = self.final_step
        self._folder = folder
        self._action_space = action_space
        marks = (settings.medium_return, settings.expert_return)
        self._marks = [mark for mark in marks if mark is not None]
        self._step = 0
        self._scores: list[Score] = []
        self._pending: list[dict[str, Tensor]] = []  # transitions that are not written yet

    @cached_property
    def parts(self) -> TransitionParts:
        """All transitions up to the newest checkpoint, numbered by step."""
        return TransitionParts(self._folder / "seen")

    def reach(self, name: str, mark: float | None) -> Score:
        """Trains from the newest checkpoint until the mark is reached, unless it already was."""
        self._load()
        while (score := self._first(mark)) is None:
            if self._step >= self.final_step:
                raise ValueError(self._why_never(name, mark))
            write_text_atomic(self._folder / "recipe.json", recipe_to_json(self.recipe))
            with Run(self._folder, self.recipe) as run:
                train(self.recipe, run, [self])
            self._load()
        return score

    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """Loads the weights that were saved at a mark."""
        _, weights = load_checkpoint(self._folder / "agents", score.step)
        policy = self.algorithm.policy
        policy.load_state_dict(weights)
        return policy.eval()

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
        ends = step >= self.final_step
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
        if mark is None:
            reached = (score for score in self._scores if score.step >= self.final_step)
        else:
            reached = (score for score in self._scores if score.mean >= mark)
        return next(reached, None)

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
            f"{len(self._scores)} evaluations had a mean return of {best:.1f}. Raise total_steps, "
            "and the same command resumes; or choose another mark and another folder"
        )
