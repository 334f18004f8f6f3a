"""The trials of a search as CSV, and how much each field mattered."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from optuna import Study
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial, TrialState

from torchrl_tit.files import write_text_atomic

_FEWEST = 4  # minimum number of complete trials for computing importances


def write_trials(study: Study, fields: Sequence[str], folder: Path) -> None:
    """Writes ``trials.csv``, and ``importance.csv`` once there are four complete trials.

    Args:
        study: the search.
        fields: the names of the fields that are searched.
        folder: the folder to write to.
    """
    trials = study.get_trials(deepcopy=False)
    header = ["trial", "state", "value", "started", "seconds", "step", *fields]
    rows = (_row(trial, fields) for trial in trials)
    write_text_atomic(folder / "trials.csv", _to_csv(header, rows))
    found = importances(study)
    if found:
        write_text_atomic(
            folder / "importance.csv", _to_csv(["field", "importance"], found.items())
        )


def importances(study: Study) -> dict[str, float]:
    """Computes how much each field mattered for the values of complete trials.

    These are the shares of PED-ANOVA (arXiv 2304.10255), which compares the best tenth of the
    trials with all of them. They add up to 1; the largest comes first.

    Returns:
        The shares by the fields' names; empty with fewer than four complete trials, or if all of
        them have the same value.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(complete) < _FEWEST or len({trial.value for trial in complete}) < 2:
        return {}
    return get_param_importances(study, evaluator=PedAnovaImportanceEvaluator())


def _row(trial: FrozenTrial, fields: Sequence[str]) -> list[Any]:
    value = trial.value
    if value is None and trial.intermediate_values:  # it was pruned: report its last return
        value = trial.intermediate_values[max(trial.intermediate_values)]
    return [
        trial.number,
        trial.state.name.lower(),
        value,
        trial.datetime_start.isoformat(" ", "seconds") if trial.datetime_start else None,
        f"{trial.duration.total_seconds():.1f}" if trial.duration else None,
        trial.last_step,
        *(_cell(trial.params.get(field)) for field in fields),
    ]


def _cell(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, list | tuple | dict | bool) else value


def _to_csv(header: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
