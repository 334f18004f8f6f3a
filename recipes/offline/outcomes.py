"""What the evaluations of a run on a data set gave, as ``evaluation.json`` holds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from torchrl_tit.datasets import has_reference, normalized_score, normalized_spread


@dataclass(frozen=True)
class Outcome:
    """Returns of the episodes that were played at one step of training, for one target return."""

    step: int
    returns: list[float]
    target_return: float | None = None
    """The return that was asked for; None where the network is asked for none."""

    @property
    def mean(self) -> float:
        """Mean return."""
        return sum(self.returns) / len(self.returns)


def summarize(
    outcomes: Sequence[Outcome], earlier: Sequence[Outcome], dataset: str, env: str
) -> dict[str, Any]:
    """What ``evaluation.json`` holds.

    Args:
        outcomes: of the newest step, one for each target return.
        earlier: of any earlier step; may be empty.
        dataset: name of the data set.
        env: name of the task.

    Returns:
        ``mean``, ``std`` (population), ``episodes`` and ``returns`` of the better target return,
        and ``score``, normalised as D4RL does: ``last``, of the better target, and ``best``, over
        all steps and targets (returns as they are where there is no reference). Where returns are
        asked for, ``target_return`` is the better one, and ``targets`` holds the same for each.
    """
    best = max(outcomes, key=lambda outcome: outcome.mean)
    highest = max(outcome.mean for outcome in [*outcomes, *earlier])
    summary = {
        "mean": best.mean,
        **_spread(best, env),
        "score": {"best": _score(highest, env), "last": _score(best.mean, env)},
        "env": env,
        "dataset": dataset,
        "steps": best.step,
        "returns": best.returns,
    }
    if best.target_return is None:
        return summary
    targets = {
        f"{outcome.target_return:g}": {
            "mean": outcome.mean,
            **_spread(outcome, env),
            "score": _score(outcome.mean, env),
            "returns": outcome.returns,
        }
        for outcome in outcomes
    }
    return {**summary, "target_return": best.target_return, "targets": targets}


def _spread(outcome: Outcome, env: str) -> dict[str, float]:
    std = torch.tensor(outcome.returns, dtype=torch.float64).std(correction=0).item()
    score_std = normalized_spread(std, env) if has_reference(env) else std
    return {"std": std, "score_std": score_std, "episodes": len(outcome.returns)}


def _score(mean: float, env: str) -> float:
    return normalized_score(mean, env) if has_reference(env) else mean
