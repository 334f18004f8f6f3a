"""A cell of the paper's tables."""

from __future__ import annotations

from dataclasses import dataclass

from .experiments import label
from .reported import Published


@dataclass(frozen=True)
class Cell:
    """All runs of the same settings: one cell of a table.

    A run's value is the mean return of its evaluation, or its best normalised score if it has one
    (offline recipes).
    """

    table: str
    """The paper's table that it belongs to."""
    recipe: str
    runs: int
    steps: int
    """Training steps; the minimum over the runs."""
    mean: float
    """Mean of the runs' values."""
    std: float
    """Standard deviation of the runs' values (population)."""
    std_episodes: float
    """Standard deviation over the episodes of a run, as the paper's online tables seem to report
    it; the mean over the runs."""
    iqm: float
    """Interquartile mean of the runs' values (arXiv 2108.13264)."""
    low: float
    """Lower end of its 95% confidence interval, by bootstrap over runs; NaN for a single run."""
    high: float
    """Upper end."""
    paper_mean: float
    """The paper's value; NaN if it has none. Recipes with other settings (-protocol, -tuned) have
    the value of the plain recipe."""
    paper_std: float
    changes: str = ""
    """Fields in which the runs differ from the recipe of that name, with the runs' values."""

    measure: str = "return"
    """What the values are: "return" or "normalized score"."""

    published: tuple[Published, ...] = ()
    """What others report for the same task and kind of network."""

    @property
    def label(self) -> str:
        """The recipe's name, and the changed fields."""
        return label(self.recipe, self.changes)
