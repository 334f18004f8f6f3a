"""A run folder: everything that an experiment leaves, and what it needs to go on."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import filelock

from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint, save_checkpoint
from torchrl_tit.files import write_text_atomic

from .metrics import Metrics
from .recipe import Recipe, recipe_from_json, recipe_to_json
from .results.plot import plot_learning_curve

_CURVE = "learning_curve.png"
_PACKAGES = ["torchrl-tit", "torch", "torchrl", "tensordict", "gymnasium", "mujoco", "numpy"]


class Run:
    """The folder of one training run.

        recipe.json        the recipe, from which the run can be started again
        versions.json      Python and the packages it ran with
        metrics.csv        one row of numbers a batch
        tensorboard/       the same for TensorBoard
        checkpoints/       numbered by step; the newest complete one is loaded
        learning_curve.png
        evaluation.json    returns of the evaluation episodes

    Use :meth:`create` or :meth:`open`, and the folder as a context: one process at a time.

    Args:
        folder: the folder.
        recipe: what is run.
    """

    def __init__(self, folder: Path, recipe: Recipe) -> None:
        self.folder = folder
        self.recipe = recipe
        self._lock = filelock.FileLock(folder / ".lock", timeout=0)

    @classmethod
    def create(cls, folder: Path, recipe: Recipe) -> Run:
        """Makes a new run folder.

        Raises:
            FileExistsError: if the folder is there already and not empty.
        """
        cls.check_new(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_text_atomic(folder / "versions.json", json.dumps(package_versions(), indent=2) + "\n")
        write_text_atomic(folder / "recipe.json", recipe_to_json(recipe))
        return cls(folder, recipe)

    @staticmethod
    def check_new(folder: Path) -> None:
        """Raises FileExistsError where :meth:`create` would."""
        # recipe.json comes last: without it, what a killed process began here is no run yet.
        if folder.exists() and (
            not folder.is_dir()
            or any(
                path.name != "versions.json" and path.name[0] != "." for path in folder.iterdir()
            )
        ):
            raise FileExistsError(
                f"{folder} exists already: continue it with `train --resume {folder}`, or name "
                "another folder with --out"
            )

    @classmethod
    def open(cls, folder: Path) -> Run:
        """Opens a run folder that is there.

        Raises:
            FileNotFoundError: if there is no run in the folder.
            ValueError: if its recipe cannot be read.
        """
        path = folder / "recipe.json"
        if not path.is_file():
            raise FileNotFoundError(f"{folder} is no run folder: there is no {path}")
        return cls(folder, recipe_from_json(path.read_bytes(), path))

    def __enter__(self) -> Run:
        try:
            self._lock.acquire()
        except filelock.Timeout as error:
            raise RuntimeError(
                f"{self.folder} is in use by another process: wait for it, or stop it"
            ) from error
        return self

    def __exit__(self, *exception: object) -> None:
        self._lock.release()

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints."""
        return self.folder / "checkpoints"

    def save(self, step: int, state: dict[str, Any]) -> None:
        """Saves a checkpoint."""
        save_checkpoint(self.checkpoints, step, state)

    def load(self) -> tuple[int, dict[str, Any]] | None:
        """Loads the newest checkpoint: (step, state), or None where there is none yet.

        Raises:
            CheckpointError: if it is damaged or not one of ours.
        """
        return load_checkpoint(self.checkpoints) if checkpoint_steps(self.checkpoints) else None

    def load_trained(self) -> tuple[int, dict[str, Any]]:
        """Loads the newest checkpoint of a run that has been trained: (step, state).

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: as :meth:`load`.
        """
        loaded = self.load()
        if loaded is None:
            raise FileNotFoundError(f"{self.checkpoints} holds no checkpoint: train the run first")
        return loaded

    @contextmanager
    def restoring(self, step: int) -> Iterator[None]:
        """Says what is wrong where a checkpoint's state does not fit what the recipe builds."""
        try:
            yield
        except (LookupError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(
                f"the checkpoint of step {step} in {self.checkpoints} does not fit "
                f"{self.folder / 'recipe.json'}; was that changed since? ({error})"
            ) from error

    def metrics(self, columns: list[str], last_step: int) -> Metrics:
        """Opens the metrics, keeping the rows up to a step."""
        return Metrics(self.folder, columns, last_step)

    def save_evaluation(self, evaluation: dict[str, Any], path: Path | None = None) -> Path:
        """Writes an evaluation as JSON, to ``evaluation.json`` unless told otherwise."""
        path = path or self.folder / "evaluation.json"
        write_text_atomic(path, json.dumps(evaluation, indent=2) + "\n")
        return path

    def is_complete(self) -> bool:
        """Whether the run is trained, evaluated and drawn: there is nothing left to do."""
        try:
            evaluation = json.loads((self.folder / "evaluation.json").read_text(encoding="utf-8"))
            evaluated = evaluation["steps"] >= self.recipe.final_step
        except (OSError, ValueError, LookupError, TypeError):
            return False
        return evaluated and (self.folder / _CURVE).is_file()

    def plot(self) -> Path:
        """Draws ``learning_curve.png`` from the metrics and returns its path."""
        path = self.folder / _CURVE
        plot_learning_curve(
            self.folder / "metrics.csv",
            path,
            title=self.recipe.name,
            offline=self.recipe.offline,
        )
        return path

    def version_changes(self) -> list[str]:
        """What differs between the versions the run began with and those of this process."""
        path = self.folder / "versions.json"
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # lost or damaged: nothing to compare with
            return []
        now = package_versions()
        return [f"{k} {before.get(k)} -> {now[k]}" for k in now if before.get(k) != now[k]]


def package_versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that results depend on, by name."""
    versions = {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
    }
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # a clone that is not installed
            versions[package] = "not installed"
    return versions
