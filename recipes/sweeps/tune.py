"""Hyperparameter search over a recipe's fields, with Optuna."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import filelock
import msgspec
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState
from tqdm import tqdm

from torchrl_tit.files import remove_leftovers, write_text_atomic

from ..algorithm import make_algorithm
from ..interrupt import raise_on_signals
from ..metrics import read_metrics
from ..recipe import Recipe
from ..recipe_json import recipe_to_json
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
        ValueError: if the folder holds another search.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.folder = folder
        self.settings = settings
        _write_or_compare(folder / "settings.json", _to_json(settings))
        _write_or_compare(folder / "space.json", msgspec.json.encode(settings.space).decode())
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        seed = settings.recipe.seed
        with _journal(folder / "study.log") as storage:
            self.study = optuna.create_study(
                study_name=settings.recipe.name or settings.recipe.algorithm,
                storage=storage,
                direction="maximize",
                load_if_exists=True,
                sampler=optuna.samplers.TPESampler(
                    n_startup_trials=settings.startup_trials, seed=seed, constant_liar=True
                ),
                pruner=optuna.pruners.MedianPruner(
                    n_startup_trials=settings.startup_trials,
                    n_warmup_steps=int(settings.warmup * settings.recipe.final_step),
                ),
            )

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
        """
        try:
            with filelock.FileLock(self.folder / ".lock", timeout=0):
                remove_leftovers(self.folder)
                try:
                    return self._run(trials, workers)
                finally:
                    self._write_trials()
        except filelock.Timeout as error:
            raise RuntimeError(
                f"{self.folder} is in use by another process: wait for it, or stop it"
            ) from error

    def _run(self, trials: int, workers: int) -> list[int]:
        ended = [trial for trial in self.study.trials if trial.state.is_finished()]
        # Trials that a killed process left behind are resumed.
        running = [
            _Trial(self, Trial(self.study, trial._trial_id))
            for trial in self.study.trials
            if trial.state == TrialState.RUNNING
        ]
        failed = [t.number for t in ended if t.state == TrialState.FAIL]
        shown = ""
        done = len(ended)  # not progress.n: a disabled progress bar does not count
        progress = tqdm(total=trials, initial=done, unit=" trials")
        with raise_on_signals(), progress:
            try:
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
                            if state == TrialState.FAIL:
                                failed.append(trial.number)
                    best = self.best()
                    text = f"best {best.value:.1f}, trial {best.number}" if best else ""
                    if text != shown:
                        progress.set_postfix_str(text)
                        shown = text
            except KeyboardInterrupt:
                for trial in running:
                    trial.stop()
                raise
        return failed

    def _write_trials(self) -> None:
        write_trials(self.study, list(self.settings.space), self.folder)

    def best(self) -> FrozenTrial | None:
        """The best trial so far, whose recipe is in ``best.json``; None before the first."""
        if not self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            return None
        best = self.study.best_trial
        path = self.folder / "best.json"
        text = (self.folder / f"trial-{best.number}.json").read_text(encoding="utf-8")
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_text_atomic(path, text)
        return best


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
        self.reported = -1
        self.jobs: list[Job] | None = None
        try:
            values = {
                field: search.settings.space[field].suggest(trial, field)
                for field in search.settings.space
            }
            recipe = with_values(search.settings.recipe, values, search.folder / "space.json")
            make_algorithm(recipe).check()
        except ValueError as error:  # values that do not fit together
            self.folder.mkdir(exist_ok=True)
            write_text_atomic(self.folder / "error.log", f"error: {error}\n")
            return
        if recipe.name:  # a name belongs to the settings of its recipe
            recipe = replace(recipe, name=f"{recipe.name}/trial-{self.number}")
        write_text_atomic(self.file, recipe_to_json(recipe))
        self.jobs = [
            Job(replace(recipe, seed=seed), self.folder / f"seed-{seed}", source=str(self.file))
            for seed in search.settings.seeds
        ]

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
        job = next((job for job in self.jobs if not job.is_complete()), None)
        if job is None:
            means = [
                json.loads((job.folder / "evaluation.json").read_bytes())["mean"]
                for job in self.jobs
            ]
            return self._end(TrialState.COMPLETE, sum(means) / len(means))
        if not job.is_in_use():  # by a process that a killed search left behind
            self.process = start(job)
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

    def _end(self, state: TrialState, value: float | None = None) -> TrialState:
        self.study.tell(self.number, value, state=state)
        return state


@contextmanager
def _journal(path: Path) -> Iterator[JournalStorage]:
    """Optuna's storage; raises ValueError if it cannot read what is in the file."""
    try:
        yield JournalStorage(JournalFileBackend(str(path)))
    except (AssertionError, KeyError, TypeError, ValueError) as error:  # of damaged lines
        raise ValueError(
            f"{path} is no whole journal of Optuna's ({type(error).__name__}: {error}): name "
            "another folder with --out, or take the damaged line out"
        ) from error


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
        path.parent.mkdir(parents=True, exist_ok=True)
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
