"""Hyperparameter search over a recipe's fields, with Optuna."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import filelock
import msgspec
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState
from tqdm import tqdm

from torchrl_tit.agents.folder import read_evaluation
from torchrl_tit.files import remove_leftovers, write_bytes_atomic, write_text_atomic

from ..algorithm import make_algorithm
from ..chosen_frames import with_chosen_frames
from ..interrupt import raise_on_signals
from ..metrics import read_metrics
from ..recipe import Recipe
from ..recipe_json import recipe_to_json
from ..run import Run
from .search_space import SearchSpace, with_values
from .sweep import Job, start
from .trials import write_trials

_WINDOW = 5  # batches over which a trial's return is averaged when trials are compared


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
        study.log       Optuna's journal of all trials
        trial-N.json    the recipe of a trial, and trial-N/ its run folders
        best.json       the recipe of the best trial, which ``train`` takes
        trials.csv      every trial: its state, value and fields
        importance.csv  how much each field mattered, from four complete trials on

    Trials are drawn by Optuna's tree-structured Parzen estimator and stopped early by its median
    pruner, on returns of training episodes. A trial's value is the mean of its evaluations. Its
    recipe is named after the searched one, followed by ``/trial-N``.

    Args:
        folder: the folder.
        settings: the search.

    Raises:
        RuntimeError: if another process is using the search.
        ValueError: if the folder holds another search, ``study.log`` is damaged or holds values
            that this search cannot have written, or the run of a trial has other values.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.folder = folder
        self.settings = settings
        self.journal = folder / "study.log"
        folder.mkdir(parents=True, exist_ok=True)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        with self._locked():
            _write_or_compare(folder / "settings.json", _to_json(settings))
            _write_or_compare(folder / "space.json", msgspec.json.encode(settings.space).decode())
            self.study = self._open_study()
            self._check_runs()

    def _open_study(self) -> optuna.Study:
        settings, path = self.settings, self.journal
        # The folder is locked: a lock of the journal was left behind by a process that was killed.
        Path(f"{path}.lock").unlink(missing_ok=True)
        name = settings.recipe.name or settings.recipe.algorithm
        try:
            _cut_half_line(path)
            # Optuna's default lock is a symbolic link, which does not work with a relative path.
            lock = JournalFileOpenLock(str(path))
            storage = JournalStorage(JournalFileBackend(str(path), lock))
            others = set(optuna.get_all_study_names(storage)) - {name}
            if others:
                raise ValueError(f"it holds the study {min(others)!r}, not {name!r}")
            study = optuna.create_study(
                study_name=name,
                storage=storage,
                direction="maximize",
                load_if_exists=True,
                pruner=optuna.pruners.MedianPruner(
                    n_startup_trials=settings.startup_trials,
                    n_warmup_steps=int(settings.warmup * settings.recipe.final_step),
                ),
            )
            if study.directions != [StudyDirection.MAXIMIZE]:
                raise ValueError("its study does not maximize one value")
            for trial in study.trials:
                _check_trial(trial, settings.space)
        except OSError:
            raise
        except Exception as error:  # a damaged line can fail in any way
            reason = " ".join(str(error).split())
            raise ValueError(
                f"{path} is not an intact journal of this search ({type(error).__name__}: "
                f"{reason}): remove the damaged line, or name another folder with --out"
            ) from error
        study.sampler = optuna.samplers.TPESampler(
            n_startup_trials=settings.startup_trials,
            # So that a resumed search does not draw the values of its first trials again.
            seed=settings.recipe.seed + len(study.trials),
            constant_liar=True,
        )
        return study

    def _check_runs(self) -> None:
        """Raises ValueError if the run of a complete trial has other values than the trial."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            for seed in self.settings.seeds:
                folder = self.folder / f"trial-{trial.number}" / f"seed-{seed}"
                path = folder / "recipe.json"
                if not path.is_file():
                    continue
                recipe = Run.open(folder).recipe
                if with_values(recipe, trial.params, path) != recipe:
                    raise ValueError(
                        f"{folder} holds a run with other settings than trial {trial.number} in "
                        f"{self.journal}: name another folder with --out, or move it away"
                    )

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            with filelock.FileLock(self.folder / ".lock", timeout=0):
                yield
        except filelock.Timeout as error:
            raise RuntimeError(
                f"{self.folder} is in use by another process: wait for it, or stop it"
            ) from error

    def run(self, trials: int, workers: int) -> list[int]:
        """Runs trials, some at a time, until the given number has ended.

        Args:
            trials: number of trials in the whole search, including those of earlier calls.
            workers: number of trials at a time, each in its own process.

        Returns:
            Numbers of the trials that failed; their output is in their logs.

        Raises:
            KeyboardInterrupt: after Ctrl-C, once all workers have saved a checkpoint.
            RuntimeError: if another process is using the search.
            ValueError: if a trial's folder holds a run with other settings.
        """
        with self._locked():
            remove_leftovers(self.folder)
            try:
                return self._run(trials, workers)
            finally:
                self._write_trials()

    def _run(self, trials: int, workers: int) -> list[int]:
        ended = [trial for trial in self.study.trials if trial.state.is_finished()]
        # Trials that a killed process left behind are resumed.
        running = [
            _Trial(self, Trial(self.study, trial._trial_id))
            for trial in self.study.trials
            if trial.state == TrialState.RUNNING
        ]
        failed = [t.number for t in ended if t.state == TrialState.FAIL]
        done = len(ended)  # not progress.n: a disabled progress bar does not count
        progress = tqdm(total=trials, initial=done, unit=" trials")
        with raise_on_signals(), progress:
            try:
                self._show_best(progress)
                while done < trials:
                    room = min(workers, trials - done)
                    while len(running) < room:
                        running.append(_Trial(self, self.study.ask()))
                    time.sleep(0.2)
                    for trial in running[:room]:  # a killed search may have left more
                        state = trial.advance()
                        if state is not None:
                            running.remove(trial)
                            done += 1
                            progress.update()
                            self._write_trials()
                            self._show_best(progress)
                            if state == TrialState.FAIL:
                                failed.append(trial.number)
            except BaseException:
                for trial in running:
                    trial.stop()
                raise
        return failed

    def _write_trials(self) -> None:
        write_trials(self.study, list(self.settings.space), self.folder)

    def _show_best(self, progress: tqdm[Any]) -> None:
        if best := self.best():
            progress.set_postfix_str(f"best {best.value:.1f}, trial {best.number}")

    def best(self) -> FrozenTrial | None:
        """The best trial so far, whose recipe is in ``best.json``; None before the first."""
        if not self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            return None
        best = self.study.best_trial
        recipe = self.recipe(best.number, best.params)
        write_text_atomic(self.folder / "best.json", recipe_to_json(recipe))
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
        if not recipe.name:
            return recipe
        # A name belongs to the settings of its recipe.
        return replace(recipe, name=f"{recipe.name}/trial-{number}")


class _Trial:
    """A running trial: its runs, one seed after another, each in its own process."""

    def __init__(self, search: Search, trial: Trial) -> None:
        self.study = search.study
        self.trial = trial
        self.number = trial.number
        self.settings = search.settings
        self.file = search.folder / f"trial-{trial.number}.json"
        self.folder = search.folder / f"trial-{trial.number}"
        self.process: subprocess.Popen[bytes] | None = None
        self.started: Job | None = None  # the process's
        self.reported = -1
        self.jobs: list[Job] | None = None
        space = search.settings.space
        try:
            values = {field: space[field].suggest(trial, field) for field in space}
        except ValueError as error:  # of earlier trials with other choices
            raise ValueError(f"{search.journal} is of another search space: {error}") from error
        try:
            recipe = search.recipe(self.number, values)
            algorithm = make_algorithm(recipe)
            algorithm.check()
        except ValueError as error:  # values that do not fit together
            self._explain(str(error))
            return
        chosen, _ = with_chosen_frames(recipe, algorithm)
        self.jobs = [
            Job(replace(chosen, seed=seed), self.folder / f"seed-{seed}", source=str(self.file))
            for seed in search.settings.seeds
        ]
        for job in self.jobs:
            job.check()  # a run with other settings says nothing about this trial
        write_text_atomic(self.file, recipe_to_json(recipe))

    def advance(self) -> TrialState | None:
        """Starts, watches or ends the trial; returns its state once it has ended."""
        if self.jobs is None:
            return self._end(TrialState.FAIL)
        if self.process is not None and self.process.poll() is None:
            if self._should_prune():
                self.stop()
                return self._end(TrialState.PRUNED)
            return None
        if self.process is not None and self.process.returncode:
            return self._end(TrialState.FAIL)
        if self.started is not None and not self.started.is_complete():
            self._explain(f"the process ended, but the run {self.started.folder} is not complete")
            return self._end(TrialState.FAIL)
        job = next((job for job in self.jobs if not job.is_complete()), None)
        if job is None:
            return self._end(TrialState.COMPLETE, fmean(map(_read_mean, self.jobs)))
        if not job.is_in_use():  # by a process that a killed search left behind
            self.process, self.started = start(job), job
        return None

    def stop(self) -> None:
        """Lets the process save a checkpoint, and waits until it exits."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait()

    def _should_prune(self) -> bool:
        """Whether the first seed's returns are below the median of earlier trials."""
        assert self.jobs is not None
        path = self.jobs[0].folder / "metrics.csv"
        if not path.is_file():
            return False
        rows = [row for row in read_metrics(path) if not math.isnan(row["return_mean"])]
        if not rows or rows[-1]["step"] <= self.reported:
            return False
        self.reported = int(rows[-1]["step"])
        returns = [row["return_mean"] for row in rows[-_WINDOW:]]
        self.trial.report(sum(returns) / len(returns), self.reported)
        return self.trial.should_prune()

    def _explain(self, reason: str) -> None:
        """Writes why the trial failed."""
        self.folder.mkdir(exist_ok=True)
        write_text_atomic(self.folder / "error.log", f"error: {reason}\n")

    def _end(self, state: TrialState, value: float | None = None) -> TrialState:
        self.study.tell(self.number, value, state=state)
        return state


def _cut_half_line(path: Path) -> None:
    """Removes the last line of a journal if a process was killed while writing it.

    Raises:
        ValueError: if another line is not JSON.
    """
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            json.loads(line)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    if whole != content:
        write_bytes_atomic(path, whole)
        warnings.warn(
            f"removed the last line of {path}, which was written only in part", stacklevel=2
        )


def _check_trial(trial: FrozenTrial, space: SearchSpace) -> None:
    """Raises ValueError if a search in this space cannot have written the trial."""
    for field, value in (trial.system_attrs.get("fixed_params", {}) | trial.params).items():
        if field not in space or not space[field].contains(value):
            raise ValueError(f"trial {trial.number} has {field} {value!r}, not in the search space")
    values, reported = trial.values or [], trial.intermediate_values
    for number in [*values, *reported, *reported.values()]:
        if not isinstance(number, float | int) or not math.isfinite(number):
            raise ValueError(f"trial {trial.number} has the return {number!r}, not a finite number")
    complete = len(values) == 1 and trial.params.keys() == space.keys()
    if len(values) > 1 or (trial.state == TrialState.COMPLETE and not complete):
        raise ValueError(f"trial {trial.number} lacks a field, or does not have one return")


def _read_mean(job: Job) -> float:
    """Reads the mean return of a complete run."""
    evaluation = read_evaluation(job.folder)
    assert evaluation is not None  # the run is complete
    return float(evaluation["mean"])


def _to_json(settings: Settings) -> str:
    fields = {
        "recipe": json.loads(recipe_to_json(settings.recipe)),
        "seeds": settings.seeds,
        "startup_trials": settings.startup_trials,
        "warmup": settings.warmup,
    }
    return json.dumps(fields, indent=2) + "\n"


def _write_or_compare(path: Path, text: str) -> None:
    if not path.exists():
        if (path.parent / "study.log").exists():
            raise ValueError(
                f"{path} is missing, so it is not known which search {path.parent} holds: name "
                "another folder with --out, or move it away"
            )
        write_text_atomic(path, text)
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path} cannot be read ({error}): name another folder with --out"
        ) from error
    if before != json.loads(text):
        raise ValueError(
            f"{path.parent} holds a search with other settings: name another folder with --out, "
            "or move it away"
        )
