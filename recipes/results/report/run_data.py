"""What a report reads from run folders."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...metrics import parse_metrics
from ...recipe import Recipe
from ...run import Run
from ..experiments import Experiment, check_together, find_runs, group_runs

_LONGEST = 40  # letters of a name in a legend


@dataclass(frozen=True)
class RunData:
    """A run: its metrics, its evaluation and the versions that it began with."""

    run: Run
    metrics: dict[str, np.ndarray]
    """The columns of ``metrics.csv``, float [rows]."""
    evaluation: dict[str, Any] | None
    """The run's evaluation; None if it is not evaluated yet."""
    versions: dict[str, Any]

    @property
    def label(self) -> str:
        """Its seed."""
        return f"seed {self.run.recipe.seed}"

    @property
    def steps(self) -> int:
        """The steps in its metrics."""
        return int(self.metrics["step"][-1])

    @property
    def seconds(self) -> float:
        """Training time without interruptions: the steps divided by their speeds."""
        steps, speed = self.metrics["step"], self.metrics["steps_per_second"]
        done = np.diff(steps, prepend=0)
        return float((done[speed > 0] / speed[speed > 0]).sum())


@dataclass(frozen=True)
class Group:
    """The runs of an experiment, and its name in the report."""

    experiment: Experiment
    label: str
    """Its name without the common prefix of all experiments."""
    runs: tuple[RunData, ...]

    @property
    def recipe(self) -> Recipe:
        """The settings of its runs, except seed and machine."""
        return self.experiment.settings

    @property
    def columns(self) -> list[str]:
        """The metrics of its runs that are known at some step, without step and time."""
        return [
            name
            for name in self.runs[0].metrics
            if name not in ("step", "time")
            and any(np.isfinite(run.metrics[name]).any() for run in self.runs)
        ]


def read_groups(folders: Iterable[Path]) -> list[Group]:
    """Reads runs and groups those of the same settings.

    Args:
        folders: run folders, or folders with run folders somewhere below.

    Raises:
        ValueError: if a folder holds no run, a run is damaged or has no metrics, two runs are the
            same, or runs have different tasks or different kinds of steps.
    """
    experiments = group_runs(find_runs(folders))
    check_together(experiments)
    labels = _labels(experiments)
    return [
        Group(experiment, label, tuple(_read(run) for run in _by_seed(experiment.runs)))
        for experiment, label in zip(experiments, labels, strict=True)
    ]


def _by_seed(runs: Iterable[Run]) -> list[Run]:
    return sorted(runs, key=lambda run: run.recipe.seed)


def _read(run: Run) -> RunData:
    rows = parse_metrics(run.read("metrics.csv"), run.folder / "metrics.csv")
    if not rows:
        raise ValueError(
            f"{run.folder} has no metrics yet: train it first, or leave it out of the report"
        )
    metrics = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    missing = [name for name in ("step", "return_mean") if name not in metrics]
    if missing:
        raise ValueError(f"{run.folder / 'metrics.csv'} is damaged: it has no column {missing[0]}")
    if "steps_per_second" not in metrics:  # a run from an earlier version
        metrics["steps_per_second"] = np.diff(metrics["step"], prepend=np.nan) / np.diff(
            metrics.get("time", metrics["step"]), prepend=np.nan
        )
    return RunData(run, metrics, run.read_evaluation(), _versions(run))


def _versions(run: Run) -> dict[str, Any]:
    try:
        found = json.loads(run.read("versions.json") or b"")
    except (OSError, ValueError):  # missing or damaged: the report says that they are unknown
        return {}
    return found if isinstance(found, dict) else {}


def _labels(experiments: Sequence[Experiment]) -> list[str]:
    """Short names: the parts in which the names of recipes, or else of folders, differ."""
    if len(experiments) == 1:
        return [_last_part(experiments[0].name)]
    names = _without_common_part([experiment.label.split("/") for experiment in experiments])
    if max(map(len, names)) > _LONGEST:
        folders = [_folder(experiment) for experiment in experiments]
        names = _without_common_part([list(folder.parts) for folder in folders])
    if len({*names, ""}) <= len(names):  # one is empty, or two are the same
        return [f"{number + 1}: {experiment.name}" for number, experiment in enumerate(experiments)]
    return names


def _folder(experiment: Experiment) -> Path:
    """The common folder of an experiment's runs, whose names are seeds."""
    folders = [run.folder.resolve() for run in experiment.runs]
    if len(folders) == 1:
        return folders[0].parent if re.fullmatch(r"seed-\d+", folders[0].name) else folders[0]
    return Path(os.path.commonpath(folders))


def _without_common_part(names: Sequence[list[str]]) -> list[str]:
    shared = 0
    while all(len(name) > shared + 1 and name[shared] == names[0][shared] for name in names):
        shared += 1
    return ["/".join(name[shared:]) for name in names]


def _last_part(name: str) -> str:
    return name.rpartition("/")[2]
