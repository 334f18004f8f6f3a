"""The loop around the gradient steps of recipes that train on data sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from tqdm import tqdm

from ..interrupt import Interrupt
from ..metrics import Metrics
from ..run import Run
from .recipe import OfflineRecipe
from .side_by_side import common_step
from .state import TrainingState


@dataclass(frozen=True)
class Training:
    """A run, and what is trained in it."""

    recipe: OfflineRecipe[Any]
    """The settings."""
    run: Run
    """An open run folder."""
    agent: Any
    """What is trained: the recipe's agent."""
    state: TrainingState
    """All that belongs into a checkpoint."""

    def open_metrics(self, terms: Sequence[str], step: int) -> Metrics:
        """Opens the metrics, keeping the rows up to a step."""
        returns = self.recipe.outcome_columns().values()
        columns = ["return_mean", *returns, *terms, *self.recipe.schedule(0)]
        return self.run.metrics(columns, last_step=step)

    def evaluate(self, step: int) -> dict[str, float]:
        """Plays the evaluation's episodes and returns columns of metrics."""
        self.agent.eval()
        outcomes = self.recipe.play(self.agent, step)
        self.agent.train()
        self.state.outcomes += outcomes
        returns = {"return_mean": max(outcome.mean for outcome in outcomes)}
        for target, column in self.recipe.outcome_columns().items():
            returns[column] = next(o.mean for o in outcomes if o.target_return == target)
        return returns

    def log(self, metrics: Metrics, terms: Sequence[str], step: int, evaluation_due: bool) -> float:
        """Adds a row of metrics, after an evaluation where it is due; returns the mean return."""
        returns = dict.fromkeys(["return_mean", *self.recipe.outcome_columns().values()], math.nan)
        if evaluation_due:
            returns |= self.evaluate(step)
        means = dict(zip(terms, self.state.take_means(), strict=True))
        metrics.log(step, **returns, **means, **self.recipe.schedule(step - 1))
        return returns["return_mean"]


def run_updates(
    trainings: Sequence[Training],
    terms: Sequence[str],
    update: Callable[[int], Tensor],
    *,
    finite: int | None = None,
) -> None:
    """Takes gradient steps to the end of a run, with evaluations, metrics and checkpoints.

    Args:
        trainings: the run; or several whose settings differ in the seed alone. Their states are
            loaded from their newest checkpoints.
        terms: names of what a gradient step gives.
        update: takes one, the first where it is given 0, and returns its terms, float [terms]; of
            several runs, float [runs, terms].
        finite: how many of the terms, from the first on, have to be finite; all where not given.

    Raises:
        FloatingPointError: if a term is not finite, before it is logged and before a checkpoint.
    """
    recipe = trainings[0].recipe
    step = common_step([training.run for training in trainings])
    for training in trainings:
        training.state.load(training.run, step)
        training.agent.train()

    def check() -> None:
        for one in trainings:
            of = f" of seed {one.recipe.seed}" if len(trainings) > 1 else ""
            one.state.check([f"{name}{of}" for name in terms[:finite]], step)

    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        progress = stack.enter_context(
            tqdm(
                total=recipe.final_step,
                initial=step,
                unit=" updates",
                desc=recipe.name,
                smoothing=0.05,
            )
        )
        metrics = [
            stack.enter_context(closing(training.open_metrics(terms, step)))
            for training in trainings
        ]
        while step < recipe.final_step:
            values = update(step).view(len(trainings), len(terms))
            for training, row in zip(trainings, values, strict=True):
                training.state.add(row)
            step += 1
            evaluation_due = recipe.evaluation_due(step)
            if evaluation_due or step % recipe.log_interval == 0:
                check()
                returns = [
                    training.log(rows, terms, step, evaluation_due)
                    for training, rows in zip(trainings, metrics, strict=True)
                ]
                if evaluation_due:
                    progress.set_postfix_str(f"return {', '.join(f'{r:.1f}' for r in returns)}")
            progress.update()
            checkpoint_due = evaluation_due or step % recipe.checkpoint_interval == 0
            if checkpoint_due or interrupt.requested:
                check()
                for training in trainings:
                    training.state.save(training.run, step)
            if interrupt.requested:
                raise KeyboardInterrupt
