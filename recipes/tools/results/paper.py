"""The paper's tables as data, and which of their cells a run belongs to (arXiv 2212.14538)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from torchrl_tit.settings.checks import printable

from ...core.recipe import DatasetRecipe, Recipe
from ...core.registry import RECIPES, get_recipe
from .experiments import TASK, changes_of, fields_of
from .package_rows import read_rows

HEADINGS = {
    "1": "table 1: online, images",
    "2": "table 2: online, arrays",
    "3": "table 3: offline",
    "4": "tables 4 and 11: ablations",
    "11": "tables 4 and 11: ablations",
    "10": "table 10: CQL",
}
"""What the paper's tables of results are about, by their numbers."""

_KIND = ("backbone.frame.encoder", "backbone.history.encoder", "backbone.num_frames")
"""The fields that determine which kind of network learns."""
_OF_THE_RUN = {"name", "collectors", "evaluation_seed", "log_interval", "ray"}
"""Fields with which the same is learned."""


@dataclass(frozen=True)
class PaperCell:
    """A cell of the paper's tables of results."""

    tables: tuple[str, ...]
    """The numbers of the tables that it stands in."""
    task: str
    """Its task or data set."""
    network: str
    """Its row, as the paper calls it."""
    mean: float
    """NaN where the paper has a dash."""
    std: float
    """As printed; NaN if nothing is."""
    curves_std: float
    """For Decision Transformer, the standard deviation of the curves that the authors published:
    the paper applied the score's offset to it. NaN for all others."""
    recipes: tuple[str, ...]
    """Named recipes that measure it: with the settings of the authors' code, and then with the
    paper's own where they differ. None for results that the paper quotes."""
    note: str
    """Where it is quoted from, or what no recipe can do as the paper did."""
    digits: int
    """Decimals that the paper prints."""

    def __str__(self) -> str:
        """The number as the paper prints it, such as "-97 ± 7"."""
        if self.mean != self.mean:
            return "-"
        mean = f"{self.mean:.{self.digits}f}"
        return mean if self.std != self.std else f"{mean} ± {self.std:.{self.digits}f}"


@dataclass(frozen=True)
class Hyperparameter:
    """A row of the paper's tables of hyperparameters."""

    table: str
    name: str
    """As in the paper; empty for a setting that it does not list."""
    values: tuple[str, ...]
    """As in the paper; empty if it says nothing, so that any value is as good."""
    fields: tuple[str, ...]
    """The fields of a recipe that hold it."""

    def allows(self, value: Any, usual: Any) -> bool:
        """Whether the paper lists a value; ``usual`` is the one of the named recipe."""
        if not self.values:
            return True
        if self.values == ("observation size",):
            return value in (None, usual)
        return str(value) in self.values


@dataclass(frozen=True)
class Match:
    """A cell of the paper for a run, and what differs from how it was measured."""

    cell: PaperCell
    differs: str
    """Empty if nothing does. Otherwise the number is only near."""

    def __str__(self) -> str:
        """The paper's number, marked as near where something differs, with what does."""
        number = str(self.cell)
        if (curves := self.cell.curves_std) == curves:
            number += f" (from its curves ± {curves:g})"
        return f"near {number}: {self.differs}" if self.differs else number


@cache
def paper_cells() -> tuple[PaperCell, ...]:
    """Returns all cells of the paper's tables of results, in its order.

    Example:
        >>> cells = [cell for cell in paper_cells() if "2" in cell.tables]
        >>> len(cells), cells[0].task, str(cells[0]), cells[0].note
        (36, 'Acrobot', '-73 ± 18', 'quoted from rl-zoo: one tuned run, a million steps')
    """
    return tuple(
        PaperCell(
            tables=tuple(row["tables"].split()),
            task=row["task"],
            network=row["network"],
            mean=float(row["mean"] or "nan"),
            std=float(row["std"] or "nan"),
            curves_std=float(row["curves_std"] or "nan"),
            recipes=tuple(row["recipes"].split()),
            note=row["note"],
            digits=len(row["mean"].partition(".")[2]),
        )
        for row in read_rows("paper_results.csv")
    )


@cache
def hyperparameters(table: str) -> tuple[Hyperparameter, ...]:
    """Returns a table of hyperparameters of the paper: 5, 6, 7 or 9.

    Example:
        >>> hyperparameters("5")[1]
        Hyperparameter(table='5', name='patch size', values=('6', '12', '42'), ...
    """
    return tuple(
        Hyperparameter(
            table,
            row["name"],
            (row["values"],) if " size" in row["values"] else tuple(row["values"].split()),
            tuple(row["fields"].split()),
        )
        for row in read_rows("paper_hyperparameters.csv")
        if row["table"] == table
    )


def hyperparameter_table(cell: PaperCell) -> str:
    """Returns the number of the paper's table of hyperparameters for a cell.

    Example:
        >>> hyperparameter_table(find_cell("cql/hopper-medium-v0/enhanced-tit"))
        '7'
    """
    if "3" in cell.tables:
        return "7" if "CQL" in cell.network else "9"
    return "6" if "2" in cell.tables else "5"


@cache
def find_cell(name: str) -> PaperCell | None:
    """Finds the cell of a recipe's name; the suffixes -tuned, -protocol and -paper do not count.

    Example:
        >>> find_cell("ppo/mountaincar/enhanced-tit").mean
        -97.0
    """
    cells = {recipe: cell for cell in paper_cells() for recipe in cell.recipes}
    plain = {plain_name(recipe): cell for recipe, cell in cells.items()}
    return cells.get(name) or plain.get(plain_name(name))


def plain_name(name: str) -> str:
    """The name without the suffix that marks other settings: "-tuned", "-protocol", "-paper".

    Example:
        >>> plain_name("ppo/acrobot/mlp-protocol"), plain_name("ppo/pong/coberl-tuned")
        ('ppo/acrobot/mlp', 'ppo/pong/coberl-tuned')
    """
    for suffix in ("-protocol", "-paper", "-tuned"):
        short = name.removesuffix(suffix)
        if short != name and (suffix != "-tuned" or name not in RECIPES):
            return short
    return name


def match(recipe: Recipe) -> Match | None:
    """Finds the paper's cell for the settings of a run, and what differs from how it was measured.

    A cell was measured with the settings of its recipes. Where the paper lists several values of a
    hyperparameter without saying which task had which, each counts as its own; so does each value
    of a setting that it leaves open.

    Args:
        recipe: the settings of a run, whose name says which cell it is about.

    Returns:
        None if task, data or kind of network are not those of the cell.

    Example:
        >>> from dataclasses import replace
        >>> recipe = get_recipe("ppo/acrobot/mlp-protocol")
        >>> print(match(recipe), "|", match(replace(recipe, epochs=4)))
        -81 ± 11 | near -81 ± 11: epochs 4
    """
    cell = find_cell(recipe.name)
    if cell is None or not has_its_data(recipe):
        return None
    found = [_differences(recipe, get_recipe(name), cell) for name in cell.recipes]
    known = [differences for differences in found if differences is not None]
    if not known:
        return None
    fewest = min(known, key=len)
    parts = [printable(f"{field} {value}") for field, value in fewest.items()]
    return Match(cell, ", ".join(parts + [cell.note] * bool(cell.note)))


def has_its_data(recipe: Recipe) -> bool:
    """Whether a recipe learns online, or from the data set that its name contains."""
    if not isinstance(recipe, DatasetRecipe):
        return True
    # D4RL's files have other names: "hopper_medium-v2.hdf5".
    stem = Path(recipe.dataset).name.removesuffix(".hdf5").replace("_", "-")
    return stem in recipe.name.split("/")


def _differences(recipe: Recipe, measured: Recipe, cell: PaperCell) -> dict[str, Any] | None:
    """The fields in which a run differs from how a cell was measured; None for another task."""
    if any(getattr(recipe, field, None) != getattr(measured, field, None) for field in TASK):
        return None
    usual, own = fields_of(measured), fields_of(recipe)
    if any(usual[field] != own[field] for field in _KIND):
        return None
    ignored = _OF_THE_RUN | (set() if recipe.offline else {"evaluation_interval"})
    if isinstance(recipe, DatasetRecipe):
        ignored.add("dataset")  # is checked by its name
    changes = {k: v for k, v in changes_of(measured, recipe).items() if k not in ignored}
    if changes.get("sequence_length") == 1:  # shuffled steps, as in Stable-Baselines3
        del changes["sequence_length"]
    rows = {f: row for row in hyperparameters(hyperparameter_table(cell)) for f in row.fields}
    is_tit = "TIT" in cell.network or "w/o" in cell.network

    def allows(field: str, value: Any) -> bool:
        return field in rows and rows[field].allows(value, usual.get(field))

    # Where the authors' code is not within the paper's table, no other value of the table goes with
    # it.
    if is_tit and all(allows(field, usual[field]) for field in rows.keys() & usual.keys()):
        changes = {k: v for k, v in changes.items() if not allows(k, v)}
    return changes
