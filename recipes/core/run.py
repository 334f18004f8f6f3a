"""A run folder: everything that an experiment writes, and what it needs to resume."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import shlex
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from torchrl_tit.checkpoint import (
    CheckpointError,
    checkpoint_steps,
    latest_step,
    load_checkpoint,
    save_checkpoint,
)
from torchrl_tit.evaluation_file import EVALUATION, parse_evaluation
from torchrl_tit.files import remove_leftovers, write_text_atomic
from torchrl_tit.settings.imports import allowed_modules

from .optional import filelock
from .recipe import Recipe
from .recipe_json import recipe_from_json, recipe_to_json
from .records import Records
from .registry import find_recipe

_IMPORTS = "imports.json"
_WEIGHTS = "initial_weights"
_LENGTHS = "earlier_lengths.json"
_WRITTEN_BEFORE = ("versions.json", _IMPORTS, _WEIGHTS)
_WRITTEN_WHOLE = (
    *("recipe.json", "versions.json", _IMPORTS, "metrics.csv", "learning_curve.png"),
    *("evaluation.json", "evaluation_best.json", _LENGTHS),
)
_PACKAGES = ["torchrl-tit", "torch", "torchrl", "tensordict", "gymnasium", "mujoco", "numpy"]


class Run:
    """The folder of one training run.

        recipe.json        the recipe, from which the run can be repeated
        initial_weights/   the weights that it took from another run, if any
        versions.json      the versions of Python and packages that it ran with
        imports.json       the user's own modules that it was started with
        metrics.csv        one row of numbers per log_interval
        tensorboard/       the same for TensorBoard
        checkpoints/       numbered by step; the newest complete one is loaded
        learning_curve.png
        evaluation.json    returns of the evaluation episodes, with the last weights
        evaluation_best.json   the same with the best ones, if they were evaluated
        earlier_lengths.json   the lengths that its schedules followed before it was trained
                               further, and until which step each applied

    Use :meth:`create` or :meth:`open`, and the run as a context manager, which only one process at
    a time can enter.

    Args:
        folder: the folder.
        recipe: the settings.
    """

    def __init__(self, folder: str | os.PathLike[str], recipe: Recipe) -> None:
        self.folder = Path(folder)
        self.recipe = recipe

    @classmethod
    def create(
        cls,
        folder: str | os.PathLike[str],
        recipe: Recipe,
        initial_weights: dict[str, Any] | None = None,
    ) -> Run:
        """Creates a new run folder.

        Args:
            folder: the folder.
            recipe: the settings.
            initial_weights: weights to start from, by their names in the algorithm's networks;
                see :func:`~recipes.core.initial_weights.weights_from`.

        Raises:
            FileExistsError: if the folder exists already and is not empty.
            RuntimeError: if another process is creating it.
        """
        cls.check_new(folder)
        run = cls(folder, recipe)
        folder = run.folder
        folder.mkdir(parents=True, exist_ok=True)
        with run:
            cls.check_new(folder)  # another process may have created it since
            run._write_versions(package_versions())
            if modules := allowed_modules():
                write_text_atomic(folder / _IMPORTS, json.dumps(modules) + "\n")
            if initial_weights is not None:
                save_checkpoint(folder / _WEIGHTS, 0, initial_weights)
            run.save_recipe(recipe)
        return run

    @staticmethod
    def check_new(folder: str | os.PathLike[str]) -> None:
        """Raises FileExistsError if :meth:`create` would."""
        folder = Path(folder)
        # recipe.json is written last: without it, what a killed process left here is not a run.
        if folder.exists() and (
            not folder.is_dir()
            or any(
                path.name not in _WRITTEN_BEFORE and path.name[0] != "."
                for path in folder.iterdir()
            )
        ):
            raise FileExistsError(
                f"{folder} exists already: resume it with `train --resume {folder}`, or name "
                "another folder with --out"
            )

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Run:
        """Opens an existing run folder.

        Raises:
            FileNotFoundError: if the folder is not a run folder.
            ValueError: if its recipe cannot be read.
        """
        folder = Path(folder)
        path = folder / "recipe.json"
        if not path.is_file():
            raise FileNotFoundError(f"{folder} is not a run folder: there is no {path}")
        try:
            return cls(folder, find_recipe(str(path)))
        except ValueError as error:
            raise ValueError(f"{error}{_import_hint(folder)}") from error

    def read(self, name: str) -> bytes | None:
        """Reads a file of the run.

        Args:
            name: its name in the folder, such as evaluation.json.

        Returns:
            Its content; None if there is no such file.
        """
        path = self.folder / name
        return path.read_bytes() if path.is_file() else None

    def read_evaluation(self, name: str = EVALUATION) -> dict[str, Any] | None:
        """Reads and checks an evaluation of the run; None if there is none.

        Args:
            name: its file.

        Raises:
            ValueError: if it is damaged; the message names the file.
        """
        content = self.read(name)
        return None if content is None else parse_evaluation(content, self.folder)

    def lengthen(self, length: int) -> None:
        """Changes the length of an open run; training then continues to the new end.

        Args:
            length: the new value of the recipe's ``length``, such as its ``total_steps``.

        Raises:
            ValueError: if the run is already past that end, or the recipe rejects the length.
        """
        field = self.recipe.length
        changes: dict[str, Any] = {field: length}
        recipe = replace(self.recipe, **changes)
        done = latest_step(self.checkpoints) or 0
        if recipe.final_step < done:
            raise ValueError(
                f"{field} {length} ends at step {recipe.final_step}, but {self.folder} is trained "
                f"for {done} steps already: name a larger number"
            )
        if done and recipe != self.recipe and recipe.schedules:
            earlier = self.earlier_lengths()
            if not earlier or earlier[-1][0] != done:
                earlier.append((done, getattr(self.recipe, field)))
            elif earlier[-1][1] == length:  # back to the length that was trained with until here
                earlier.pop()
            write_text_atomic(self.folder / _LENGTHS, json.dumps(earlier) + "\n")
        self.save_recipe(recipe)

    def save_recipe(self, recipe: Recipe) -> None:
        """Replaces the recipe of an open run."""
        write_text_atomic(self.folder / "recipe.json", recipe_to_json(recipe))
        self.recipe = recipe

    def earlier_lengths(self) -> list[tuple[int, int]]:
        """Returns the lengths that the run's schedules followed before the recipe's.

        Returns:
            A pair for each length, of a run that has schedules, with which it was trained before
            :meth:`lengthen` changed it: the step until which it had that length, and the length.

        Raises:
            ValueError: if their file is damaged.
        """
        content = self.read(_LENGTHS)
        if content is None:
            return []
        try:
            return msgspec.json.decode(content, type=list[tuple[int, int]])
        except msgspec.MsgspecError as error:
            raise ValueError(
                f"{self.folder / _LENGTHS} is damaged: expected pairs of step and length, "
                f"such as [[1024, 4096]] ({error})"
            ) from error

    def __enter__(self) -> Run:
        with ExitStack() as stack:
            stack.enter_context(locked(self.folder))
            remove_leftovers(self.folder, _WRITTEN_WHOLE)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._held.close()

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints."""
        return self.folder / "checkpoints"

    def save(self, step: int, state: dict[str, Any]) -> None:
        """Saves a checkpoint."""
        save_checkpoint(self.checkpoints, step, state)

    def load(self) -> tuple[int, dict[str, Any]] | None:
        """Loads the newest checkpoint: (step, state), or None if there is none.

        Raises:
            CheckpointError: if it is damaged, or not one of ours.
        """
        return load_checkpoint(self.checkpoints) if checkpoint_steps(self.checkpoints) else None

    def load_initial_weights(self) -> dict[str, Any]:
        """Loads the weights of another run that this one starts from; empty if there are none.

        Raises:
            CheckpointError: if they are damaged.
        """
        return load_checkpoint(self.folder / _WEIGHTS, 0)[1] if self.initial_weights else {}

    @property
    def initial_weights(self) -> str:
        """Which weights of another run it starts from, as a checksum; empty if from none."""
        content = self.read(f"{_WEIGHTS}/{0:012}/state.json")  # with the checksum of the tensors
        return "" if content is None else hashlib.sha256(content).hexdigest()[:8]

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
        """Raises ValueError if a checkpoint's state does not fit what the recipe builds.

        Its checksums only show that it is as it was written. Wrong contents can fail in any way.
        """
        try:
            yield
        except CheckpointError:  # of a part that has a folder of its own
            raise
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(
                f"the checkpoint of step {step} in {self.checkpoints} does not fit "
                f"{self.folder / 'recipe.json'} ({reason}): an older version of torchrl-tit made "
                "it, or that file was changed since; a new run can take its weights with "
                "--init-from"
            ) from error

    def save_evaluation(self, evaluation: dict[str, Any], path: Path | None = None) -> Path:
        """Writes an evaluation as JSON, by default to ``evaluation.json``."""
        path = path or self.folder / "evaluation.json"
        write_text_atomic(path, json.dumps(evaluation, indent=2) + "\n")
        return path

    def is_complete(self) -> bool:
        """Whether the run is trained and evaluated and its learning curve is drawn."""
        try:
            evaluation = self.read_evaluation()
        except (OSError, ValueError):  # it is written again
            return False
        end = self.recipe.final_step
        evaluated = evaluation is not None and evaluation["steps"] >= end
        # Without any checkpoint, it needs none; but one that was deleted is trained again.
        trained = latest_step(self.checkpoints) in (None, end)
        return evaluated and trained and self.curve.is_file()

    @property
    def curve(self) -> Path:
        """The picture of the learning curve."""
        return self.folder / "learning_curve.png"

    def versions(self) -> dict[str, Any]:
        """Returns the versions that the run ran with; none if they are lost or damaged.

        Those of a run that was resumed with others are "2.12.0 -> 2.13.0".
        """
        try:
            return dict(json.loads(self.read("versions.json") or b"{}"))
        except (OSError, RecursionError, TypeError, ValueError):
            return {}

    def version_changes(self) -> list[str]:
        """Returns how the versions of this process differ from those that the run last ran with."""
        before, now = self.versions(), package_versions()
        last = {name: str(version).split(" -> ")[-1] for name, version in before.items()}
        return [f"{k} {before.get(k)} -> {now[k]}" for k in now if before and last.get(k) != now[k]]

    def add_versions(self) -> list[str]:
        """Adds the versions of this process to the folder's; returns what changed."""
        if changes := self.version_changes():
            self._write_versions(self.versions() | dict(x.split(" ", 1) for x in changes))
        return changes

    def _write_versions(self, versions: Mapping[str, Any]) -> None:
        write_text_atomic(self.folder / "versions.json", json.dumps(versions, indent=2) + "\n")


class RecordedRun(Run):
    """A run of a table of runs, which is read as a run folder is; it has no checkpoints.

    Args:
        records: the table.
        run: the run's name in it.

    Raises:
        ValueError: if its recipe cannot be read.

    Example:
        >>> RecordedRun(Records("docs/results/hopper"), "mlp/seed-0").recipe.env
        'Hopper-v5'
    """

    def __init__(self, records: Records, run: str) -> None:
        folder = records.folder / run
        recipe = records.read(run, "recipe.json") or b""
        super().__init__(folder, recipe_from_json(recipe, folder / "recipe.json"))
        self._records, self._run = records, run

    def read(self, name: str) -> bytes | None:
        """Reads a file of the run, as far as the table holds it."""
        return self._records.read(self._run, name)

    @property
    def initial_weights(self) -> str:
        """As :attr:`Run.initial_weights`."""
        return str(json.loads(self.read("changes") or b"{}").get("initial_weights", ""))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks a folder, which only one process at a time may change.

    Raises:
        RuntimeError: if another process has locked it.
    """
    try:
        held = filelock.FileLock(folder / ".lock", timeout=0).acquire()
    except filelock.Timeout as error:
        raise RuntimeError(
            f"{folder} is in use by another process: wait for it, or stop it"
        ) from error
    with held:
        yield


def _import_hint(folder: Path) -> str:
    """Lists the modules that the user imported when the run began.

    Modules named in a file are never imported automatically.
    """
    try:
        began_with = json.loads((folder / _IMPORTS).read_text(encoding="utf-8"))
        missing = [str(module) for module in began_with if module not in allowed_modules()]
    except (OSError, RecursionError, TypeError, ValueError):
        return ""
    options = " ".join(f"--import {shlex.quote(module)}" for module in missing)
    return f"; the run began with `{options}`" if options else ""


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
