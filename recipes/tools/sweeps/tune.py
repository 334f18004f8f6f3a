"""Hyperparameter search over a recipe's fields, with Optuna."""

from __future__ import annotations

import csv
import json
import math
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial
from tqdm import tqdm

from torchrl_tit.evaluation_file import read_evaluation
from torchrl_tit.files import remove_leftovers, write_text_atomic

from ...core.algorithm import make_algorithm
from ...core.evaluation import score_of
from ...core.interrupt import raise_on_signals
from ...core.metrics import read_metrics
from ...core.networks import name_chosen_encoders
from ...core.numbers import number
from ...core.recipe import Recipe
from ...core.recipe_json import recipe_to_json
from ...core.records import to_csv
from ...core.run import locked
from .search_space import SearchSpace, make_distributions, with_values
from .sweep import Job, start

_WINDOW = 5  # batches over which a trial's return is averaged when trials are compared
_FEWEST = 4  # complete trials for computing importances


@dataclass(frozen=True)
class Settings:
    """The settings of a search, which can only be resumed with the same settings."""

    recipe: Recipe
    space: SearchSpace
    seeds: tuple[int, ...] = (0,)
    """Seeds that every trial is run with, one after another."""
    startup_trials: int = 5
    """Trials that are drawn at random, and that run to their end before any trial is pruned."""
    warmup: float = 0.3
    """Share of a trial's first run during which it is not pruned."""

    def __post_init__(self) -> None:
        for seed in self.seeds:
            replace(self.recipe, seed=seed)  # raises ValueError if the seed is invalid


class Search:
    """A search in a folder, which another process can resume if the first is killed.

        settings.json   recipe, seeds and pruning
        space.json      the search space
        trials.csv      every trial: its state, value and fields
        trial-N.json    the recipe of a trial, and trial-N/ its run folders
        best.json       the recipe of the best trial, which ``train`` takes
        importance.csv  how much each field mattered, from four complete trials on

    Trials are drawn by Optuna's tree-structured Parzen estimator and stopped early by its median
    pruner, on returns of training episodes. A trial's value is the mean of its evaluations. Its
    recipe is named after the searched one, followed by ``/trial-N``.

    Optuna's study is made anew from ``trials.csv`` and the trials' run folders, so nothing else has
    to be kept in step with them. The folder is locked between ``with`` and its end.

    Args:
        folder: the folder.
        settings: the search.

    Raises:
        RuntimeError: if another process is using the search.
        ValueError: if the folder holds another search, ``trials.csv`` is damaged or holds values
            that this search cannot have drawn, or the run of a trial has other values.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.folder = folder
        self.settings = settings
        self.space = make_distributions(settings.space)
        self._held = ExitStack()

    def __enter__(self) -> Search:
        self.folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            stack.enter_context(locked(self.folder))
            remove_leftovers(self.folder)
            self._load()
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def _load(self) -> None:
        settings = self.settings
        self._write_or_compare("settings.json", _to_json(settings))
        self._write_or_compare("space.json", json.dumps(settings.space), _read_space)
        trials = self._read_trials()
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.study = optuna.create_study(
            direction="maximize",
            sampler=optuna.samplers.TPESampler(
                n_startup_trials=settings.startup_trials,
                # So that a resumed search does not draw the values of its first trials again.
                seed=settings.recipe.seed + len(trials),
                constant_liar=True,
            ),
            pruner=optuna.pruners.MedianPruner(
                n_startup_trials=settings.startup_trials,
                n_warmup_steps=int(settings.warmup * settings.recipe.final_step),
            ),
        )
        self._running: list[_Trial] = []
        for earlier in trials:
            if earlier.state in (TrialState.FAIL, TrialState.PRUNED):
                self.study.add_trial(earlier)
                continue
            self.study.enqueue_trial(earlier.params)
            trial = _Trial(self, self.study.ask(self.space))
            if trial.is_waiting():
                self._running.append(trial)
            else:
                trial.advance()  # it is complete, or cannot be run
        self._write_trials()

    def _read_trials(self) -> list[FrozenTrial]:
        path = self.folder / "trials.csv"
        if not path.exists():
            return []
        try:
            with path.open(encoding="utf-8", newline="") as file:
                return [self._parse(number, row) for number, row in enumerate(csv.DictReader(file))]
        except (AttributeError, LookupError, TypeError, ValueError, csv.Error) as error:
            raise ValueError(
                f"{path} is not an intact table of this search's trials ({type(error).__name__}: "
                f"{' '.join(str(error).split())}): name another folder with --out"
            ) from error

    def _parse(self, number: int, row: Mapping[str, str]) -> FrozenTrial:
        """Reads a row of ``trials.csv``; raises an error if this search cannot have written it."""
        if row["trial"] != str(number):
            raise ValueError(f"trial {number} is missing")
        value = float(row["value"] or 0)
        if not math.isfinite(value):
            raise ValueError(f"trial {number} has the return {value}, not a finite number")
        state = TrialState[row["state"].upper()]
        return create_trial(  # checks that the values are in the search space
            state=state,
            value=value if state == TrialState.COMPLETE else None,
            params={field: _value(row[field], kind) for field, kind in self.space.items()},
            distributions=self.space,
            intermediate_values={int(row["step"]): value} if row["step"] else {},
        )

    def _write_or_compare(
        self, name: str, text: str, read: Callable[[str], Any] = json.loads
    ) -> None:
        path, advice = self.folder / name, "name another folder with --out, or move it away"
        if not path.exists():
            if (self.folder / "trials.csv").exists():
                raise ValueError(
                    f"{path} is missing, so it is not known which search {self.folder} holds: "
                    f"{advice}"
                )
            write_text_atomic(path, text)
            return
        try:
            before = read(path.read_text(encoding="utf-8"))
        except (AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"{path} cannot be read ({error}): {advice}") from error
        if before != read(text):
            raise ValueError(f"{self.folder} holds a search with other settings: {advice}")

    def run(self, trials: int, workers: int) -> list[int]:
        """Runs trials until there are so many in all; resumes those that were killed.

        Args:
            trials: number of trials, with those of earlier calls.
            workers: trials at a time, each in its own process.

        Returns:
            The numbers of the trials that failed; their output is in ``trial-N/seed-SEED.log`` and
            ``trial-N/error.log``.

        Raises:
            KeyboardInterrupt: after Ctrl-C, once all workers have stopped.
        """
        ended = sum(trial.state.is_finished() for trial in self.study.trials)
        with raise_on_signals(), tqdm(total=trials, initial=ended, unit=" trials") as progress:
            try:
                self._show_best(progress)
                while ended < trials:
                    room = min(workers, trials - ended)
                    while len(self._running) < room:
                        drawn = self.study.ask(self.space)
                        self._write_trials()  # before anything of it starts
                        self._running.append(_Trial(self, drawn))
                    time.sleep(0.2)
                    for trial in self._running[:room]:  # a killed search may have left more
                        if trial.advance():
                            self._running.remove(trial)
                            ended += 1
                            progress.update()
                            self._write_trials()
                            self._show_best(progress)
            except BaseException:
                for trial in self._running:
                    trial.stop()
                raise
            finally:
                self._write_trials()
        failed = self.study.get_trials(deepcopy=False, states=(TrialState.FAIL,))
        return [trial.number for trial in failed]

    def _show_best(self, progress: tqdm[Any]) -> None:
        if best := self.best():
            progress.set_postfix_str(f"best {number(best.values[0])}, trial {best.number}")

    def best(self) -> FrozenTrial | None:
        """The best trial so far, whose recipe is in ``best.json``; None before the first."""
        if not self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            return None
        best = self.study.best_trial
        text = recipe_to_json(self.recipe(best.number, best.params))
        write_text_atomic(self.folder / "best.json", text)
        return best

    def recipe(self, number: int, values: Mapping[str, Any]) -> Recipe:
        """Returns the recipe of a trial.

        Args:
            number: number of the trial.
            values: its values, by the fields' names.

        Raises:
            ValueError: if the recipe rejects them.
        """
        recipe = with_values(self.settings.recipe, values, self.folder / "space.json")
        # A name belongs to the settings of its recipe.
        return replace(recipe, name=f"{recipe.name}/trial-{number}") if recipe.name else recipe

    def _write_trials(self) -> None:
        rows: list[list[Any]] = [["trial", "state", "value", "step", *self.space]]
        for trial in self.study.get_trials(deepcopy=False):
            value = trial.value
            if value is None and trial.intermediate_values:  # it was pruned: its last return
                value = trial.intermediate_values[max(trial.intermediate_values)]
            cells = [_cell(trial.params[field]) for field in self.space]
            rows.append([trial.number, trial.state.name.lower(), value, trial.last_step, *cells])
        write_text_atomic(self.folder / "trials.csv", to_csv(rows))
        if shares := importances(self.study):
            rows = [["field", "importance"], *map(list, shares.items())]
            write_text_atomic(self.folder / "importance.csv", to_csv(rows))


class _Trial:
    """A running trial: its runs, one seed after another, each in its own process."""

    def __init__(self, search: Search, trial: Trial) -> None:
        self.study = search.study
        self.trial = trial
        self.folder = search.folder / f"trial-{trial.number}"
        self.jobs: list[Job] | None = None
        self.process: subprocess.Popen[bytes] | None = None
        self.started: Job | None = None  # the process's
        self.was_killed = False
        try:
            recipe = search.recipe(trial.number, trial.params)
            algorithm = make_algorithm(recipe)
            if not self.folder.exists():  # otherwise it was checked before its runs began
                algorithm.check()
        except ValueError as error:  # values that do not fit together
            self._explain(str(error))
            return
        chosen, _ = name_chosen_encoders(algorithm)
        file = search.folder / f"trial-{trial.number}.json"
        self.jobs = [
            Job(replace(chosen, seed=seed), self.folder / f"seed-{seed}", source=str(file))
            for seed in search.settings.seeds
        ]
        for job in self.jobs:
            job.check()  # a run with other settings says nothing about this trial
        write_text_atomic(file, recipe_to_json(recipe))
        self._report()

    def is_waiting(self) -> bool:
        """Whether any of its runs is to be started or resumed."""
        return not all(job.is_complete() for job in self.jobs or ())

    def advance(self) -> bool:
        """Starts, watches or ends the trial; returns whether it has ended."""
        if self.jobs is None:
            return self._end(TrialState.FAIL)
        if self.process is not None and self.process.poll() is None:
            if self._report() and self.trial.should_prune():
                self.stop()
                return self._end(TrialState.PRUNED)
            return False
        if self.process is not None and self.process.returncode:
            # Code 2: refused, as a process that a killed search left behind started the run first.
            assert self.started is not None
            begun = self.started.is_in_use() or self.started.is_complete()
            killed = self.process.returncode < 0 and not self.was_killed  # it is resumed once
            if killed or (self.process.returncode == 2 and begun):
                self.was_killed |= killed
                self.process = self.started = None
                return False
            return self._end(TrialState.FAIL)
        if self.started is not None and not self.started.is_complete():
            self._explain(f"the process ended, but the run {self.started.folder} is not complete")
            return self._end(TrialState.FAIL)
        job = next((job for job in self.jobs if not job.is_complete()), None)
        if job is None:
            self._report()
            evaluations = [read_evaluation(job.folder) or {} for job in self.jobs]
            return self._end(TrialState.COMPLETE, fmean(map(score_of, evaluations)))
        if not job.is_in_use():  # by a process that a killed search left behind
            self.process, self.started = start(job), job
        return False

    def stop(self) -> None:
        """Lets the process save a checkpoint, and waits until it exits."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait()

    def _report(self) -> bool:
        """Tells Optuna the returns of the first seed's run; returns whether there are new ones."""
        assert self.jobs is not None
        path = self.jobs[0].folder / "metrics.csv"
        if not path.is_file():
            return False
        rows = [row for row in read_metrics(path) if not math.isnan(row["return_mean"])]
        known = self.study.get_trials(deepcopy=False)[self.trial.number].intermediate_values
        new = [index for index, row in enumerate(rows) if int(row["step"]) not in known]
        for index in new:
            window = rows[max(0, index + 1 - _WINDOW) : index + 1]
            mean = fmean(row["return_mean"] for row in window)
            self.trial.report(mean, int(rows[index]["step"]))
        return bool(new)

    def _explain(self, reason: str) -> None:
        """Writes why the trial failed."""
        self.folder.mkdir(exist_ok=True)
        write_text_atomic(self.folder / "error.log", f"error: {reason}\n")

    def _end(self, state: TrialState, value: float | None = None) -> bool:
        self.study.tell(self.trial, value, state=state)
        return True


def importances(study: optuna.Study) -> dict[str, float]:
    """Computes how much each field mattered for the values of complete trials.

    These are the shares of PED-ANOVA (arXiv 2304.10255), which compares the best tenth of the
    trials with all of them. They add up to 1; the largest comes first.

    Returns:
        The shares by the fields' names; empty for fewer than four trials, or if all have the same
        value.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(complete) < _FEWEST or len({trial.value for trial in complete}) < 2:
        return {}
    return get_param_importances(study, evaluator=PedAnovaImportanceEvaluator())


def _read_space(text: str) -> dict[str, BaseDistribution]:
    return make_distributions(json.loads(text))


def _cell(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _value(cell: str, distribution: BaseDistribution) -> Any:
    if isinstance(distribution, CategoricalDistribution):
        return {_cell(choice): choice for choice in distribution.choices}[cell]
    return float(cell) if isinstance(distribution, FloatDistribution) else int(cell)


def _to_json(settings: Settings) -> str:
    fields = {
        "recipe": json.loads(recipe_to_json(settings.recipe)),
        "seeds": settings.seeds,
        "startup_trials": settings.startup_trials,
        "warmup": settings.warmup,
    }
    return json.dumps(fields, indent=2) + "\n"
