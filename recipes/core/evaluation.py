"""Results of evaluations, and the contents of ``evaluation.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import torch

from torchrl_tit.scores import has_reference, normalized_score, normalized_spread

from .recipe import DatasetRecipe, Recipe


@dataclass(frozen=True)
class Outcome:
    """Returns of the episodes that were played at one step of training, for one target return."""

    step: int
    returns: Annotated[list[float], msgspec.Meta(min_length=1)]
    target_return: float | None = None
    """The target return; None if the network has none."""

    @property
    def mean(self) -> float:
        """Mean return."""
        return sum(self.returns) / len(self.returns)


@dataclass(frozen=True)
class HeldOut:
    """What was measured on held-out episodes at one step of training."""

    step: int
    episodes: Annotated[int, msgspec.Meta(ge=1)]
    """Number of these episodes."""
    values: dict[str, float]
    """The measures by name; the first is an error, which decides which weights are the best where
    there is no environment."""

    @property
    def error(self) -> float:
        """The first measure."""
        return next(iter(self.values.values()))

    def entries(self) -> dict[str, Any]:
        """What ``evaluation.json`` says of them."""
        return {
            "steps": self.step,
            "held_out": self.values,
            "held_out_episodes": self.episodes,
        }


def summarize(
    outcomes: Sequence[Outcome],
    earlier: Sequence[Outcome],
    recipe: Recipe,
    held_out: HeldOut | None = None,
) -> dict[str, Any]:
    """Returns the contents of ``evaluation.json``.

    Args:
        outcomes: outcomes of the newest step, one for each target return; none without an
            environment.
        earlier: those of earlier steps; may be empty.
        recipe: the settings.
        held_out: what was measured on held-out episodes at that step, if any are.

    Returns:
        ``held_out``, the measures, and ``held_out_episodes``, if there are such. Without an
        environment, otherwise only ``env``, ``dataset`` and ``steps``. With one, also ``mean``,
        ``std`` (population), ``episodes`` and ``returns`` of the better target return, ``env``, and
        the ``steps`` that the networks were trained for. For a run on a data set also
        the ``dataset`` and the ``score``, normalized as D4RL does: ``last``, of the better target,
        and ``best``, over all steps and targets (raw returns if there is no reference).
        With target returns, ``target_return`` is the better one, and ``targets`` holds the
        same for each.
    """
    env, measured = recipe.env, {} if held_out is None else held_out.entries()
    if not outcomes:
        assert isinstance(recipe, DatasetRecipe)
        return {"env": env, "dataset": recipe.dataset, **measured}
    best = max(outcomes, key=lambda outcome: outcome.mean)
    summary: dict[str, Any] = {"mean": best.mean, "std": _std(best), "episodes": len(best.returns)}
    if isinstance(recipe, DatasetRecipe):
        highest = max(outcome.mean for outcome in [*outcomes, *earlier])
        summary |= {
            "score": {"best": _score(highest, env), "last": _score(best.mean, env)},
            "score_std": _score_std(best, env),
            "dataset": recipe.dataset,
        }
    summary |= {"env": env, "steps": best.step, "returns": best.returns, **measured}
    if best.target_return is None:
        return summary
    targets = {
        f"{outcome.target_return:g}": {
            "mean": outcome.mean,
            "std": _std(outcome),
            "score_std": _score_std(outcome, env),
            "episodes": len(outcome.returns),
            "score": _score(outcome.mean, env),
            "returns": outcome.returns,
        }
        for outcome in outcomes
    }
    return {**summary, "target_return": best.target_return, "targets": targets}


def score_of(evaluation: Mapping[str, Any]) -> float:
    """Returns what an evaluation is judged by: its mean return, or minus its held-out error."""
    if "mean" in evaluation:
        return float(evaluation["mean"])
    return -float(next(iter(evaluation["held_out"].values())))


def _std(outcome: Outcome) -> float:
    return torch.tensor(outcome.returns, dtype=torch.float64).std(correction=0).item()


def _score_std(outcome: Outcome, env: str) -> float:
    std = _std(outcome)
    return normalized_spread(std, env) if has_reference(env) else std


def _score(mean: float, env: str) -> float:
    return normalized_score(mean, env) if has_reference(env) else mean
