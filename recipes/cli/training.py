"""A run from start to end: training, evaluation, learning curve."""

from __future__ import annotations

import shlex
import time
import warnings
from collections import defaultdict
from collections.abc import Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from torchrl_tit.settings.imports import import_options

from ..core import runner
from ..core.algorithm import make_algorithm
from ..core.callback import Callback
from ..core.initial_weights import weights_from
from ..core.networks import name_chosen_encoders
from ..core.recipe import Recipe
from ..core.run import Run
from ..tools.results.plot import plot_run
from ..tools.wandb_metrics import WandbMetrics, check_wandb
from .arguments import note, option, override, program, say
from .evaluate import one_line

_SHARE = 5
"""A run is checked after one part in this many, because the first episodes are often short."""
_ENOUGH = 100
"""Minimum number of episodes for a warning."""


def start(
    recipe: Recipe, folder: Path | None, init_from: Path | None = None, wandb: str | None = None
) -> None:
    """Starts a run; writes nothing if its recipe cannot be run.

    Args:
        recipe: the recipe.
        folder: the run folder to make; runs/NAME/seed-SEED-DATE if None.
        init_from: the run whose weights to start from, if any.
        wandb: the project of Weights & Biases that metrics are sent to, if any.
    """
    check_wandb(wandb)
    algorithm = make_algorithm(recipe)
    algorithm.check()
    if algorithm.recipe.env_settings != recipe.env_settings:
        say(f"taken from the data: {', '.join(algorithm.recipe.env_settings)}")
    weights = None
    if init_from is not None:
        weights, report = weights_from(init_from, algorithm)
        say(report)
    recipe, chosen = name_chosen_encoders(algorithm)
    if chosen:
        say(f"frames chosen by kind of observation: {chosen}")
    with Run.create(folder or _make_folder(recipe), recipe, weights) as run:
        _finish(run, wandb)


def resume(
    folder: Path,
    device: str | None = None,
    threads: int | None = None,
    lengths: Mapping[str, int] | None = None,
    wandb: str | None = None,
) -> None:
    """Resumes a run, or trains a finished one further.

    Args:
        folder: the run folder.
        device: the device to use; the recipe's if None.
        threads: the number of PyTorch's threads; the recipe's if None.
        lengths: the run's new length by the name of its field, such as ``total_steps``; the
            recipe's if None.
        wandb: as in :func:`start`.
    """
    check_wandb(wandb)
    settings: dict[str, Any] = {"device": device, "threads": threads}
    with Run.open(folder) as run:
        if lengths:
            _lengthen(run, lengths, settings)
        run.recipe = override(run.recipe, **settings)
        _finish(run, wandb)


def _lengthen(run: Run, lengths: Mapping[str, int], settings: Mapping[str, Any]) -> None:
    """Changes the length of a run that can be resumed, and says which schedules that affects."""
    field = run.recipe.length
    if wrong := [name for name in lengths if name != field]:
        raise ValueError(
            f"{run.folder} is a run of {run.recipe.algorithm}, whose length is {option(field)}, "
            f"not {option(wrong[0])}"
        )
    make_algorithm(override(run.recipe, **settings, **lengths)).check()
    before = getattr(run.recipe, field)
    run.lengthen(lengths[field])
    if run.recipe.schedules and lengths[field] != before:
        note(
            f"{', '.join(run.recipe.schedules)} depends on {field}: from here on it is that "
            f"of a run with {field} {lengths[field]}, and before it was that of {before}"
        )


def _finish(run: Run, wandb: str | None) -> None:
    """Finishes an open run: trains, evaluates and plots what is left."""
    recipe, folder = run.recipe, run.folder
    if run.is_complete():
        say(
            f"{folder} is complete: trained for {recipe.final_step} {recipe.unit} and evaluated; "
            f"{option(recipe.length)} trains it further"
        )
        return
    if changes := run.add_versions():
        note(f"versions changed since the start: {'; '.join(changes)}")
    try:
        with ExitStack() as stack:
            callbacks: list[Callback] = [] if recipe.offline else [UnusedFrames(recipe)]
            if wandb is not None:
                callbacks.append(stack.enter_context(closing(WandbMetrics(run, wandb))))
            runner.train(recipe, run, callbacks)
            evaluation = runner.evaluate(run, callbacks=callbacks)
    except KeyboardInterrupt:
        words = [*program().split(), "train", "--resume", str(folder), *import_options()]
        words += [] if wandb is None else ["--wandb", wandb]
        note(f"stopped; to resume: {shlex.join(words)}", "")
        raise
    run.save_evaluation(evaluation)
    plot_run(run)
    say(one_line(recipe, evaluation))
    say(f"run folder: {folder}\nlearning curve: {run.curve}")


def _make_folder(recipe: Recipe) -> Path:
    """Creates a folder immediately, so that runs started in the same second get different ones."""
    name = recipe.name or recipe.algorithm
    base = Path("runs", name, f"seed-{recipe.seed}-{time.strftime('%Y%m%d-%H%M%S')}")
    base.parent.mkdir(parents=True, exist_ok=True)
    folder, number = base, 1
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
            folder = base.with_name(f"{base.name}-{number}")


class UnusedFrames(Callback):
    """Warns once if no episode in the first fifth of a run was as long as the history.

    The network then reads more frames than the task's episodes have.

    Args:
        recipe: the settings of a run that learns from steps it collects.
    """

    def __init__(self, recipe: Recipe) -> None:
        self._num_frames = recipe.backbone.num_frames
        self._judged_at = recipe.final_step // _SHARE
        self._over = self._num_frames == 1
        self._running: defaultdict[int, int] = defaultdict(int)  # by environment
        self._longest = self._episodes = 0

    def collected(self, step: int, batch: Any) -> None:
        """Measures the episodes of a batch [envs, time], and warns when it is time."""
        if self._over:
            return
        for env, dones in enumerate(batch["next", "done"].squeeze(-1).tolist()):
            for done in dones:
                self._running[env] += 1
                self._longest = max(self._longest, self._running[env])
                if done:
                    self._running[env] = 0
                    self._episodes += 1
        self._over = self._longest >= self._num_frames or step >= self._judged_at
        if self._longest < self._num_frames and self._over and self._episodes >= _ENOUGH:
            warnings.warn(
                f"num_frames is {self._num_frames}, but no episode so far had more than "
                f"{self._longest} steps: with num_frames {self._longest} the network sees as much, "
                "and trains faster",
                stacklevel=1,
            )
