"""The loop around the gradient steps of recipes that train on data sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TypeVar

from torch import Tensor
from tqdm import tqdm

from .interrupt import Interrupt
from .offline_recipe import OfflineAgent, OfflineRecipe
from .offline_state import TrainingState
from .run import Run

AgentT = TypeVar("AgentT", bound=OfflineAgent)


def run_updates(
    recipe: OfflineRecipe[AgentT],
    run: Run,
    agent: AgentT,
    state: TrainingState,
    terms: Sequence[str],
    update: Callable[[int], Tensor],
    *,
    finite: int | None = None,
) -> None:
    """Takes gradient steps to the end of a run, with evaluations, metrics and checkpoints.

    Args:
        recipe: the settings.
        run: an open run folder, from whose newest checkpoint the state is loaded.
        agent: what is trained.
        state: all that belongs into a checkpoint.
        terms: names of what a gradient step gives.
        update: takes one, the first where it is given 0, and returns its terms, float [terms].
        finite: how many of the terms, from the first on, have to be finite; all where not given.

    Raises:
        FloatingPointError: if a term is not finite, before it is logged and before a checkpoint.
    """
    step = state.load(run)
    returns_of = recipe.outcome_columns()
    columns = ["return_mean", *returns_of.values(), *terms, *recipe.schedule(0)]
    metrics = run.metrics(columns, last_step=step)
    progress = tqdm(
        total=recipe.final_step, initial=step, unit=" updates", desc=recipe.name, smoothing=0.05
    )
    with Interrupt() as interrupt, progress, closing(metrics):
        while step < recipe.final_step:
            agent.train()
            state.add(update(step))
            agent.eval()
            step += 1
            evaluation_due = recipe.evaluation_due(step)
            if evaluation_due or step % recipe.log_interval == 0:
                state.check(terms[:finite], step)
                returns = dict.fromkeys(["return_mean", *returns_of.values()], math.nan)
                if evaluation_due:
                    outcomes = recipe.play(agent, step)
                    state.outcomes += outcomes
                    returns |= {
                        returns_of[o.target_return]: o.mean
                        for o in outcomes
                        if o.target_return is not None
                    }
                    returns["return_mean"] = max(outcome.mean for outcome in outcomes)
                    progress.set_postfix_str(f"return {returns['return_mean']:.1f}")
                means = dict(zip(terms, state.take_means(), strict=True))
                metrics.log(step, **returns, **means, **recipe.schedule(step - 1))
            progress.update()
            checkpoint_due = evaluation_due or step % recipe.checkpoint_interval == 0
            if checkpoint_due or interrupt.requested:
                state.check(terms[:finite], step)
                state.save(run, step)
            if interrupt.requested:
                raise KeyboardInterrupt
