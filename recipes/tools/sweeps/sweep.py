"""Sweeps: many recipes and seeds, in worker processes on this machine or others."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm

from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.imports import import_options, load_plugins

from ...core.algorithm import make_algorithm
from ...core.interrupt import raise_on_signals
from ...core.networks import name_chosen_encoders
from ...core.recipe import Recipe
from ...core.registry import RECIPES, find_recipe, is_recipe_file, recipes_from_file
from ...core.run import Run
from ...core.trust import allow_names

PROGRAM = str(__package__).removesuffix(".tools.sweeps")
"""The module that ``python -m`` runs: ``recipes``, or ``torchrl_tit.recipes`` if it is
installed."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep: a recipe with its seed, and the folder it belongs in."""

    recipe: Recipe
    folder: Path
    source: str = ""
    """The file that holds the recipe, as the command line takes it; empty for a named recipe."""
    wandb: str = ""
    """The project of Weights & Biases that metrics are sent to, if any."""

    @property
    def log(self) -> Path:
        """The worker's output."""
        return self.folder.with_name(self.folder.name + ".log")

    def arguments(self) -> list[str]:
        """Returns the arguments of the command that starts or resumes the run.

        It imports the modules that the user named for this process.
        """
        options = [*(["--wandb", self.wandb] if self.wandb else []), *import_options()]
        if self._exists():
            return ["train", "--resume", str(self.folder), *options]
        return [
            "train",
            self.source or self.recipe.name,
            "--seed",
            str(self.recipe.seed),
            "--out",
            str(self.folder),
            *options,
        ]

    def is_complete(self) -> bool:
        """Whether there is nothing left to do."""
        return self._exists() and Run.open(self.folder).is_complete()

    def is_in_use(self) -> bool:
        """Whether a process is using the run, such as one that a killed sweep left behind."""
        if not self._exists():
            return False
        try:
            with Run.open(self.folder):
                return False
        except RuntimeError:
            return True

    def check(self) -> None:
        """Raises ValueError if the folder holds a run with other settings."""
        if self._exists() and Run.open(self.folder).recipe != self.recipe:
            raise ValueError(
                f"{self.folder} holds a run of {self.recipe.name} with other settings: name "
                "another folder with --out, or move it away"
            )

    def _exists(self) -> bool:
        return (self.folder / "recipe.json").is_file()


def make_jobs(patterns: Iterable[str], seeds: Iterable[int], out: Path) -> list[Job]:
    """Lists the runs of a sweep, and checks all of them before any starts.

    Args:
        patterns: names of recipes, patterns such as ``ppo/*/mlp``, JSON files that hold a
            recipe, such as ``tune``'s ``best.json``, or Python files, which are run.
        seeds: seeds to run every recipe with.
        out: folder of the sweep; a run's folder is ``out/NAME/seed-SEED``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a pattern matches no recipe, a file holds no recipe or one without a name,
            two recipes have the same name and different settings, a recipe cannot be built, or a
            folder holds a run with other settings.

    Example:
        >>> jobs = make_jobs(["ppo/cartpole/*-tit"], [0, 1], Path("runs/sweep"))
        >>> [str(job.folder) for job in jobs][:2]
        ['runs/sweep/ppo/cartpole/vanilla-tit/seed-0', 'runs/sweep/ppo/cartpole/vanilla-tit/seed-1']
    """
    found: dict[str, tuple[Recipe, str]] = {}  # by name, in order, each once
    for pattern in patterns:
        for recipe, source in _find(pattern):
            other, other_source = found.setdefault(recipe.name, (recipe, source))
            if replace(recipe, seed=0) != replace(other, seed=0):
                raise ValueError(
                    f"{source or 'the named recipe'} and {other_source or 'the named recipe'} are "
                    f"both called {recipe.name!r} and differ: change the field 'name' in the file"
                )
    jobs = []
    for recipe, source in found.values():
        allow_names(recipe)
        algorithm = make_algorithm(recipe)
        algorithm.check()
        recipe, _ = name_chosen_encoders(algorithm)
        for seed in dict.fromkeys(seeds):
            folder = out / recipe.name / f"seed-{seed}"
            job = Job(replace(recipe, seed=seed), folder, source)
            job.check()
            jobs.append(job)
    return jobs


def _find(pattern: str) -> list[tuple[Recipe, str]]:
    """Returns the recipes that a pattern matches, or those in a file, each with its source."""
    if is_recipe_file(pattern):
        return [(recipe, source) for source, recipe in recipes_from_file(pattern).items()]
    if pattern.endswith(".json"):
        recipe = find_recipe(pattern)
        if not recipe.name:
            raise ValueError(
                f"the recipe in {pattern} has no name, which the folders of its runs need"
            )
        return [(recipe, pattern)]
    failures = load_plugins() if pattern not in RECIPES else []
    fitting = [(recipe, "") for name, recipe in RECIPES.items() if fnmatchcase(name, pattern)]
    if not fitting:
        reasons = [f"no recipe is called {pattern!r}: {nearest(pattern, RECIPES)}", *failures]
        raise ValueError("; ".join(reasons))
    return fitting


class Worker(Protocol):
    """A run in its own process, which may be on another machine."""

    def poll(self) -> int | None:
        """Returns the exit code, which is 0 if the run is complete; None before the end."""

    def send_signal(self, number: int, /) -> None:
        """Sends the process a signal; SIGINT lets it save a checkpoint and stop."""

    def wait(self) -> int:
        """Waits for the process's end and returns its exit code."""


def start(job: Job) -> subprocess.Popen[bytes]:
    """Starts or resumes a run in its own process, which prints to the job's log."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with job.log.open("ab") as log:
        # In a new session: the terminal's Ctrl-C reaches only this process, which passes it on.
        return subprocess.Popen(
            [sys.executable, "-m", PROGRAM, *job.arguments()],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )


def run_jobs(
    jobs: list[Job],
    workers: int,
    start: Callable[[Job], Worker] = start,
    count_begun: Callable[[Collection[Any]], int] = len,
) -> list[Job]:
    """Runs the jobs that are not complete yet, some at a time, and resumes those that were killed.

    A run in use by another process is left to that process, and resumed afterwards. Ctrl-C (or
    SIGTERM) is passed on: every worker saves a checkpoint and stops.

    Args:
        jobs: the runs.
        workers: runs at a time.
        start: starts or resumes a run; by default in a process on this machine.
        count_begun: counts the started runs that no longer wait for a machine.

    Returns:
        The runs that failed; their output is in their logs.

    Raises:
        KeyboardInterrupt: after Ctrl-C, once all workers have stopped.
    """
    waiting = [job for job in jobs if not job.is_complete()]
    running: dict[Job, Worker] = {}
    failed = []
    done = len(jobs) - len(waiting)
    shown = ""
    with raise_on_signals(), tqdm(total=len(jobs), initial=done, unit=" runs") as progress:
        try:
            while waiting or running:
                idle = (job for job in waiting if not job.is_in_use())
                for job in list(islice(idle, workers - len(running))):
                    waiting.remove(job)
                    running[job] = start(job)
                text = f"{count_begun(running.values())} running"
                if waiting and len(running) < workers:
                    text += ", others in use by other processes"
                if text != shown:
                    progress.set_postfix_str(text)
                    shown = text
                time.sleep(0.2)
                for job in list(running):
                    code = running[job].poll()
                    if code is None:
                        continue
                    del running[job]
                    # Code 2: refused, because another process has just started the run. If a worker
                    # on Ray is lost (code 1), the process that it left behind may still use the
                    # run.
                    if code == 2 and job.is_in_use():
                        waiting.append(job)
                        continue
                    succeeded = not code or job.is_complete()
                    try:
                        job.check()
                    except ValueError as error:  # its file was changed after the sweep began
                        succeeded = False
                        with job.log.open("a", encoding="utf-8") as log:
                            log.write(f"error: {error}\n")
                    if not succeeded:
                        failed.append(job)
                    progress.update()
        except KeyboardInterrupt:
            for worker in running.values():
                worker.send_signal(signal.SIGINT)
            for worker in running.values():
                worker.wait()
            raise
    return failed
