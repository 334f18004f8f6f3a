"""Groups of runs with the same settings but different seeds, the unit of every comparison."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from torchrl_tit.settings.checks import printable

from ...core.metrics import parse_metrics
from ...core.recipe import Recipe, experiment_of
from ...core.recipe_json import recipe_to_json
from ...core.records import TABLE, Records, find_records
from ...core.registry import RECIPES
from ...core.run import RecordedRun, Run

TASK = ("env", "env_settings", "wrappers", "observation_keys", "hide_velocities", "mask_actions")
"""The fields that determine which task is learned."""


@dataclass(frozen=True)
class Experiment:
    """All runs of the same settings."""

    settings: Recipe
    name: str
    """The recipe's name; the first run's folder if it has none."""
    changes: str
    """Fields in which the runs differ from the recipe of that name, with the runs' values, and
    whether they started from the weights of another run."""
    runs: tuple[Run, ...]

    @property
    def label(self) -> str:
        """The name, and the changed fields."""
        return label(self.name, self.changes)


def find_runs(folders: Iterable[Path]) -> list[Run]:
    """Opens all runs in folders, each once.

    Args:
        folders: run folders, folders with run folders or tables of runs somewhere below, or paths
            in a table of runs, such as docs/results/hopper/mlp.

    Raises:
        ValueError: if a folder holds none, or the recipe of one cannot be read.
    """
    found: dict[Path, Run] = {}
    for folder in folders:
        if not (runs := _runs_below(folder)):
            raise ValueError(
                f"{folder} holds no run folder and no table of runs: there is no recipe.json and "
                f"no {TABLE} in it or below"
            )
        found |= {run.folder.resolve(): run for run in runs}
    return list(found.values())


def _runs_below(folder: Path) -> list[Run]:
    if (found := find_records(folder)) is not None:
        records, below = found
        return [RecordedRun(records, run) for run in records.below(below)]
    from torchrl_tit.agents.folder import is_agent  # not at the top: training needs no agents

    found_in = (path.parent for path in folder.rglob("recipe.json"))
    runs = [Run.open(path) for path in found_in if not is_agent(path)]
    for records in (Records(path.parent) for path in folder.rglob(TABLE)):
        runs += [RecordedRun(records, run) for run in records.rows]
    return sorted(runs, key=lambda run: run.folder)


def group_runs(runs: Iterable[Run]) -> list[Experiment]:
    """Groups runs of the same settings, ignoring seed and machine.

    Those that started from the same weights of another run have a group of their own.

    Args:
        runs: the runs.

    Returns:
        The experiments, in the order of their first runs. A name that is not registered belongs to
        the first settings that have it.

    Raises:
        ValueError: if two runs have the same settings and seed.
    """
    groups: dict[tuple[Recipe, str], dict[int, Run]] = {}
    for run in runs:
        seeds = groups.setdefault((experiment_of(run.recipe), run.initial_weights), {})
        same = seeds.setdefault(run.recipe.seed, run)
        if same is not run:
            raise ValueError(
                f"{same.folder} and {run.folder} are the same run: "
                f"{run.recipe.name or 'the same settings'} with seed {run.recipe.seed}; "
                "name one of them only"
            )
    own: dict[str, Recipe] = {}
    experiments = []
    for (settings, weights), seeds in groups.items():
        first = next(iter(seeds.values()))
        name, changes = str(first.folder), ""
        if settings.name:
            name = settings.name
            named = RECIPES.get(name) or own.setdefault(name, settings)
            changes = changed_fields(named, settings)
        moved = [f"weights of another run, {weights}"] if weights else []
        changes = ", ".join([changes] * bool(changes) + moved)
        experiments.append(Experiment(settings, name, changes, tuple(seeds.values())))
    return experiments


def check_together(experiments: Sequence[Experiment]) -> list[str]:
    """Checks that experiments can be compared, with the same task and unit of steps.

    Returns:
        A note for each experiment whose task has other settings, such as hidden velocities.

    Raises:
        ValueError: if their returns or steps cannot share an axis.
    """
    first, notes = experiments[0], []
    for other in experiments:
        names = f"{first.runs[0].folder} and {other.runs[0].folder} do not go together"
        tasks = [one.settings.task_name for one in (first, other)]
        if tasks[0] != tasks[1]:
            raise ValueError(
                f"{names}: their tasks are {tasks[0]} and {tasks[1]}; compare the runs of each task"
            )
        if other.settings.offline != first.settings.offline:
            raise ValueError(
                f"{names}: environment steps and gradient steps do not share an axis; compare the "
                "runs of each kind"
            )
        for field in TASK if first.settings.env else ():
            values = [getattr(one.settings, field, None) for one in (first, other)]
            if values[0] != values[1]:
                notes.append(
                    f"{other.label} has another task than {first.label}: {field} is {values[1]}, "
                    f"not {values[0]}"
                )
    return notes


def read_metrics(run: Run) -> list[dict[str, float]]:
    """Reads the rows of a run's metrics; none if it has none yet.

    Runs of earlier versions lack ``steps_per_second``, which follows from ``step`` and ``time``.

    Raises:
        ValueError: if a row is damaged.
    """
    rows = parse_metrics(run.read("metrics.csv"), run.folder / "metrics.csv")
    if rows and "steps_per_second" not in rows[0] and "time" in rows[0]:
        for row, before in zip(rows, [rows[0], *rows], strict=False):
            seconds = row["time"] - before["time"]
            steps = row["step"] - before["step"]
            row["steps_per_second"] = steps / seconds if seconds > 0 else math.nan
    return rows


def common_part(names: Sequence[str]) -> str:
    """Returns the part up to a "/" that names have in common.

    Example:
        >>> common_part(["ppo/cartpole/mlp", "ppo/cartpole/lstm"])
        'ppo/cartpole/'
    """
    levels = zip(*(name.split("/")[:-1] for name in names), strict=False)
    return "".join(f"{level[0]}/" for level in takewhile(lambda one: len({*one}) == 1, levels))


def label(name: str, changes: str) -> str:
    """Writes a recipe's name, and the changed fields.

    Example:
        >>> label("ppo/cartpole/mlp", "num_envs 4")
        'ppo/cartpole/mlp (num_envs 4)'
    """
    return f"{name} ({changes})" if changes else name


def changed_fields(before: Recipe, after: Recipe) -> str:
    """Names the fields in which settings differ, ignoring seed and machine.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> from dataclasses import replace
        >>> recipe = get_recipe("ppo/cartpole/mlp")
        >>> changed_fields(recipe, replace(recipe, num_envs=4, seed=7))
        'num_envs 4'
    """
    return ", ".join(
        printable(f"{field} {value}") for field, value in changes_of(before, after).items()
    )


def changes_of(before: Recipe, after: Recipe) -> dict[str, Any]:
    """Returns the fields in which settings differ, ignoring seed and machine, with the new values.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> from dataclasses import replace
        >>> recipe = get_recipe("ppo/cartpole/mlp")
        >>> changes_of(recipe, replace(recipe, num_envs=4, seed=7))
        {'num_envs': 4}
    """
    old, new = (fields_of(experiment_of(recipe)) for recipe in (before, after))
    return {
        field: value
        for field, value in new.items()
        if value != {} and (field not in old or old[field] != value)
    }


def fields_of(recipe: Recipe) -> dict[str, Any]:
    """Returns all settings as in JSON, with nested ones by their full names.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> fields_of(get_recipe("ppo/cartpole/mlp"))["backbone.num_frames"]
        1
    """
    return _flat(json.loads(recipe_to_json(recipe)))


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            fields |= _flat(value, f"{prefix}{name}.")
        else:
            fields[prefix + name] = value
    return fields
