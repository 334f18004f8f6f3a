"""Many recipes and seeds, in worker processes on this machine."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

from tqdm import tqdm

from .interrupt import raise_on_signals
from .recipe import Recipe, nearest
from .registry import RECIPES
from .run import Run


@dataclass(frozen=True)
class Job:
    """One run of a sweep: a recipe with its seed, and the folder it belongs in."""

    recipe: Recipe
    folder: Path
    source: str = ""
    """A JSON file that holds the recipe; where this is empty, it is a named one."""

    @property
    def log(self) -> Path:
        """What the worker prints."""
        return self.folder.with_name(self.folder.name + ".log")

    def command(self) -> list[str]:
        """The words that start or resume the run in a process of its own."""
        train = [sys.executable, "-m", __package__, "train"]
        if self._exists():
            return [*train, "--resume", str(self.folder)]
        return [
            *train,
            self.source or self.recipe.name,
            "--seed",
            str(self.recipe.seed),
            "--out",
            str(self.folder),
        ]

    def is_complete(self) -> bool:
        """Whether there is nothing left to do."""
        return self._exists() and Run.open(self.folder).is_complete()

    def check(self) -> None:
        """Raises ValueError where the folder holds a run with other settings."""
        if self._exists() and Run.open(self.folder).recipe != self.recipe:
            raise ValueError(
                f"{self.folder} holds a run of {self.recipe.name} with other settings: name "
                "another folder with --out, or move it away"
            )

    def _exists(self) -> bool:
        return (self.folder / "recipe.json").is_file()


def make_jobs(patterns: Iterable[str], seeds: Iterable[int], out: Path) -> list[Job]:
    """Lists the runs of a sweep, and checks all of them before any begins.

    Args:
        patterns: names of recipes, or patterns such as ``ppo/*/mlp``.
        seeds: seeds, each of which every recipe is run with.
        out: folder of the sweep; a run's folder is ``out/NAME/seed-SEED``.

    Raises:
        ValueError: if a pattern fits no recipe, a recipe cannot be built, or a folder holds a run
            with other settings.

    Example:
        >>> jobs = make_jobs(["ppo/cartpole/*-tit"], [0, 1], Path("runs/sweep"))
        >>> [str(job.folder) for job in jobs][:2]
        ['runs/sweep/ppo/cartpole/vanilla-tit/seed-0', 'runs/sweep/ppo/cartpole/vanilla-tit/seed-1']
    """
    names: dict[str, None] = {}  # in order, each once
    for pattern in patterns:
        fitting = [name for name in RECIPES if fnmatchcase(name, pattern)]
        if not fitting:
            raise ValueError(f"no recipe is called {pattern!r}: {nearest(pattern, RECIPES)}")
        names.update(dict.fromkeys(fitting))
    jobs = []
    for name in names:
        RECIPES[name].check()
        for seed in dict.fromkeys(seeds):
            job = Job(replace(RECIPES[name], seed=seed), out / name / f"seed-{seed}")
            job.check()
            jobs.append(job)
    return jobs


def run_jobs(jobs: list[Job], workers: int) -> list[Job]:
    """Runs what is not complete yet, some at a time; a run that was killed goes on where it was.

    Ctrl-C (or SIGTERM) is passed on: every worker saves a checkpoint and stops.

    Args:
        jobs: the runs.
        workers: processes at a time.

    Returns:
        The runs that failed; what they printed is in their logs.

    Raises:
        KeyboardInterrupt: after Ctrl-C, once all workers have stopped.
    """
    waiting = [job for job in jobs if not job.is_complete()]
    running: dict[Job, subprocess.Popen[bytes]] = {}
    failed = []
    done = len(jobs) - len(waiting)
    with raise_on_signals(), tqdm(total=len(jobs), initial=done, unit=" runs") as progress:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    job = waiting.pop(0)
                    running[job] = start(job)
                    progress.set_postfix_str(f"{len(running)} at work")
                time.sleep(0.2)
                for job in [job for job, process in running.items() if process.poll() is not None]:
                    if running.pop(job).returncode:
                        failed.append(job)
                    progress.update()
        except KeyboardInterrupt:
            for process in running.values():
                process.send_signal(signal.SIGINT)
            for process in running.values():
                process.wait()
            raise
    return failed


def start(job: Job) -> subprocess.Popen[bytes]:
    """Starts or resumes a run in a process of its own, which prints to the job's log."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with job.log.open("ab") as log:
        # A session of its own: the terminal's Ctrl-C reaches this process, which passes it on.
        return subprocess.Popen(
            job.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
