"""Results of evaluations, and the contents of ``evaluation.json``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import torch

from torchrl_tit.scores import has_reference, normalized_score, normalized_spread

from .dataset_recipe import DatasetRecipe
from .recipe import Recipe


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


def summarize(
    outcomes: Sequence[Outcome], earlier: Sequence[Outcome], recipe: Recipe
) -> dict[str, Any]:
    """Returns the contents of ``evaluation.json``.

    Args:
        outcomes: outcomes of the newest step, one for each target return.
        earlier: those of earlier steps; may be empty.
        recipe: the settings.

    Returns:
        ``mean``, ``std`` (population), ``episodes`` and ``returns`` of the better target return,
        ``env``, and the ``steps`` that the networks were trained for. For a run on a data set also
        the ``dataset`` and the ``score``, normalised as D4RL does: ``last``, of the better target,
        and ``best``, over all steps and targets (raw returns if there is no reference).
        With target returns, ``target_return`` is the better one, and ``targets`` holds the
        same for each.
    """
    best = max(outcomes, key=lambda outcome: outcome.mean)
    env = recipe.env
    summary: dict[str, Any] = {"mean": best.mean, "std": _std(best), "episodes": len(best.returns)}
    if isinstance(recipe, DatasetRecipe):
        highest = max(outcome.mean for outcome in [*outcomes, *earlier])
        summary |= {
            "score": {"best": _score(highest, env), "last": _score(best.mean, env)},
            "score_std": _score_std(best, env),
            "dataset": recipe.dataset,
        }
    summary |= {"env": env, "steps": best.step, "returns": best.returns}
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


def _std(outcome: Outcome) -> float:
    return torch.tensor(outcome.returns, dtype=torch.float64).std(correction=0).item()


def _score_std(outcome: Outcome, env: str) -> float:
    std = _std(outcome)
    return normalized_spread(std, env) if has_reference(env) else std


def _score(mean: float, env: str) -> float:
    return normalized_score(mean, env) if has_reference(env) else mean
