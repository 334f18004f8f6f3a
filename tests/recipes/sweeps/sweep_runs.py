"""Small runs of sweeps."""

from __future__ import annotations

from pathlib import Path

from recipes.core.recipe import Recipe
from recipes.core.run import Run
from recipes.tools.sweeps.sweep import Job
from tests.recipes.commands import Command


def begin(folder: Path, recipe: Recipe) -> Job:
    """Begins a run as a worker would, so that workers resume it with these small settings."""
    Run.create(folder, recipe)
    return Job(recipe, folder)


def fork_worker(job: Job) -> Command:
    """Starts a run in its own process, without the seconds that importing PyTorch takes."""
    job.log.parent.mkdir(parents=True, exist_ok=True)
    return Command(job.arguments(), job.log)
