"""The base class of recipes that learn from steps they collect."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_tit.settings.numbers import Steps

from .recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class OnlineRecipe(Recipe):
    """Settings of every recipe that learns from steps it collects."""

    evaluation_interval: Steps | None = None
    """Environment steps between evaluations during training, whose mean return is the column
    evaluation_return of the metrics. Without it, only the final weights are evaluated."""

    @property
    def target_columns(self) -> dict[float | None, str]:
        """The column of evaluations; online, there are no target returns."""
        return {} if self.evaluation_interval is None else {None: "evaluation_return"}

    def evaluation_due(self, before: int, step: int) -> bool:
        """See :meth:`Recipe.evaluation_due`."""
        interval = self.evaluation_interval
        return interval is not None and step // interval > before // interval
