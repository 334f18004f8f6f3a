"""The only training loop: batches, updates, metrics, evaluations, checkpoints, resume."""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_tit.checkpoint import checkpoint_steps, global_rng_state, set_global_rng_state
from torchrl_tit.evaluation import watching_episodes

from .algorithm import (
    Algorithm,
    Stateful,
    check_finite,
    load_weights,
    make_algorithm,
    naming,
)
from .best import EPISODES, Best
from .callback import Callback
from .evaluation import HeldOut, Outcome, summarize
from .free_memory import return_free_memory
from .interrupt import Interrupt
from .optional import tqdm
from .recipe import Recipe
from .run import Run


def train(recipe: Recipe, run: Run, callbacks: Sequence[Callback] = ()) -> None:
    """Trains a recipe in a run folder, from its newest checkpoint if there is one.

    No number of a run depends on when it is saved or evaluated. A run that is killed and resumed
    restores all that a checkpoint holds; what it then trains on follows from the checkpoint alone.
    On a data set, it reaches the same weights, bit for bit, as an uninterrupted one. Environments
    cannot be saved, so an online run begins new episodes, whose seeds follow from the run's seed
    and the step.

    Args:
        recipe: the settings.
        run: an open run folder.
        callbacks: hooks on batches, updates, evaluations and checkpoints; they can end training.

    Raises:
        FloatingPointError: if a reward, a loss, a gradient or a weight is not finite.
        KeyboardInterrupt: after Ctrl-C, once a checkpoint is saved.
    """
    torch.set_num_threads(recipe.threads)
    random.seed(recipe.seed)
    np.random.seed(recipe.seed)
    torch.manual_seed(recipe.seed)
    algorithm = make_algorithm(recipe)
    recipe = algorithm.recipe  # with what only its data say
    step = saved_step = max(checkpoint_steps(run.checkpoints), default=0)
    if step == 0 and (weights := run.load_initial_weights()):
        with run.restoring(step):
            networks = algorithm.model
            load_weights(networks, {**networks.state_dict(), **weights})
    if not recipe.offline and 0 < step < recipe.final_step:
        line = f"note: resuming at step {step} with new episodes: environments are not saved"
        print(line, file=sys.stderr)
    algorithm.prepare(step, run.folder)
    with ExitStack() as stack:
        stack.enter_context(closing(algorithm))
        record = Record(recipe, algorithm)
        best = Best(algorithm.model)
        parts = {
            "networks": algorithm.model,
            **algorithm.state(),
            "record": record,
            "best": best,
        }
        _load(run, parts)
        metrics = stack.enter_context(closing(run.metrics(record.columns, last_step=step)))
        progress = stack.enter_context(
            tqdm.tqdm(
                total=min([recipe.final_step, *(c.last_step for c in callbacks if c.last_step)]),
                initial=step,
                unit=f" {recipe.unit}",
                desc=recipe.name,
                smoothing=0.05,
            )
        )
        interrupt = stack.enter_context(Interrupt())
        batches = iter(algorithm.batches())
        while step < recipe.final_step:
            with _naming(f"in {recipe.env} after step {step}", saved_step):
                batch = next(batches)
            before, step = step, step + algorithm.size(batch)
            for callback in callbacks:
                callback.collected(step, batch)
            with _naming(f"in {recipe.env} after step {before}", saved_step):
                returns = algorithm.returns(batch)
            if returns is not None and not record.outcomes:
                best.add_episodes(before, returns.flatten().tolist())
            with _naming(f"in the update at step {step}", saved_step):
                record.add(returns, algorithm.update(batch, before))
            progress.update(step - before)

            evaluation_due = recipe.evaluation_due(before, step)
            # Intervals count from the start, so a resumed run logs and saves at the same steps.
            log_due = step // recipe.log_interval > before // recipe.log_interval
            if log_due or evaluation_due:
                with _naming(f"in the update at step {step}", saved_step):
                    record.check()
            enough = any([callback.updated(step, algorithm.policy) for callback in callbacks])
            if evaluation_due:
                with _naming(f"in {recipe.env}, in the evaluation at step {step}", saved_step):
                    outcomes, held_out = algorithm.play(step), algorithm.measure(step)
                if not record.outcomes and outcomes:
                    best.forget()  # training episodes do not count where there are evaluations
                record.outcomes += outcomes
                record.held_out += [] if held_out is None else [held_out]
                if outcomes:
                    best.offer(step, max(outcome.mean for outcome in outcomes))
                elif held_out is not None:
                    best.offer(step, -held_out.error)
                for callback in callbacks if outcomes else ():
                    callback.evaluated(step, outcomes)
            if log_due or evaluation_due:
                row = record.take_row(step, means=log_due)
                written = metrics.log(step, **row)
                for callback in callbacks:
                    callback.logged(step, written)
                if shown := _shown(row, algorithm):
                    progress.set_postfix_str(shown)

            interval = recipe.checkpoint_interval
            due = step // interval > before // interval or step >= recipe.final_step
            if due or evaluation_due or enough or interrupt.requested:
                with _naming(f"in the update at step {step}", saved_step):
                    record.check()
                metrics.sync()  # the checkpoint's rows must be on the disk before it
                for callback in callbacks:
                    callback.saving(step)
                _save(run, step, parts)
                saved_step = step
                for callback in callbacks:
                    callback.saved(step)
            if interrupt.requested:
                raise KeyboardInterrupt
            if enough:
                break


def _shown(row: Mapping[str, float], algorithm: Algorithm[Any]) -> str:
    """What the progress line shows of a row of metrics; nothing if it has no evaluation."""
    if not math.isnan(row["return_mean"]):
        return f"return {row['return_mean']:.1f}"
    known = {x: row[x] for x in algorithm.held_out_columns if not math.isnan(row[x])}
    words = [f"{name.removeprefix('held_out_')} {value:.3g}" for name, value in known.items()]
    return f"held out: {', '.join(words)}" if words else ""


class Record:
    """The measurements since the last row of metrics, and all evaluations so far.

    Args:
        recipe: the settings.
        algorithm: the algorithm.
    """

    def __init__(self, recipe: Recipe, algorithm: Algorithm[Any]) -> None:
        self.outcomes: list[Outcome] = []
        """The results of all evaluations so far."""
        self.held_out: list[HeldOut] = []
        """What was measured on held-out episodes so far."""
        self._recipe = recipe
        self._names = list(algorithm.columns)
        self._measured = list(algorithm.held_out_columns)
        self._required = [name not in algorithm.optional_columns for name in self._names]
        self._sums: Tensor | None = None
        self._count = 0
        self._returns: list[float] = []

    @property
    def columns(self) -> list[str]:
        """Names of the numbers in a row of metrics, besides step and time."""
        targets = self._recipe.target_columns.values()
        episodes = [] if self._recipe.offline else ["episodes"]
        return ["return_mean", *targets, *self._measured, *episodes, *self._names]

    def add(self, returns: Tensor | None, values: Mapping[str, Tensor | float]) -> None:
        """Adds the returns of a batch and the numbers of its update, without waiting for a GPU."""
        if returns is not None:
            self._returns += returns.flatten().tolist()
        device = next((x.device for x in values.values() if isinstance(x, Tensor)), None)
        terms = torch.stack(
            [
                torch.as_tensor(values[name], dtype=torch.float64, device=device)
                for name in self._names
            ]
        )
        self._sums = terms if self._sums is None else self._sums.to(terms.device) + terms
        self._count += 1

    def check(self) -> None:
        """Raises NotFiniteError if a sum is not finite."""
        if self._sums is not None:
            required = torch.tensor(self._required, device=self._sums.device)
            names = [n for n, needed in zip(self._names, self._required, strict=True) if needed]
            check_finite(names, self._sums[required])

    def take_row(self, step: int, *, means: bool = True) -> dict[str, float]:
        """Returns a row of metrics: the step's evaluation, and means since the last row of means.

        Args:
            step: number of steps so far.
            means: if off, the row has the evaluation only, and the means await a later row: they
                must not depend on when the run is evaluated.
        """
        row = dict.fromkeys(self.columns, math.nan)
        now = [outcome for outcome in self.outcomes if outcome.step == step]
        for target, column in self._recipe.target_columns.items():
            row[column] = next((o.mean for o in now if o.target_return == target), math.nan)
        if self._recipe.offline:
            row["return_mean"] = max((outcome.mean for outcome in now), default=math.nan)
        if self.held_out and self.held_out[-1].step == step:
            row |= {f"held_out_{name}": x for name, x in self.held_out[-1].values.items()}
        if not means:
            return row
        assert self._sums is not None
        row |= dict(zip(self._names, (self._sums / self._count).tolist(), strict=True))
        if not self._recipe.offline:
            episodes = len(self._returns)
            row["episodes"] = episodes
            row["return_mean"] = sum(self._returns) / episodes if episodes else math.nan
        self._sums, self._count, self._returns = None, 0, []
        return row

    def state_dict(self) -> dict[str, Any]:
        """Returns the state that the next row and the next evaluation need."""
        return {
            "outcomes": [asdict(outcome) for outcome in self.outcomes],
            "held_out": [asdict(held_out) for held_out in self.held_out],
            "evaluation_seed": self._recipe.evaluation_seed,
            "num_frames": self._recipe.backbone.num_frames,
            "sums": [] if self._sums is None else self._sums.tolist(),
            "count": self._count,
            "returns": self._returns,
        }

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        state = _record_state(state_dict, self._recipe)
        if len(state.sums) != (len(self._names) if state.count else 0):
            raise ValueError(f"the record has {len(state.sums)} sums of {state.count} updates")
        self.outcomes, self.held_out = state.outcomes, state.held_out
        self._sums = torch.tensor(state.sums, dtype=torch.float64) if state.sums else None
        self._count = state.count
        self._returns = state.returns


@dataclass(frozen=True)
class _RecordState:
    """The state of a :class:`Record` in a checkpoint."""

    outcomes: list[Outcome]
    evaluation_seed: int
    sums: list[float]
    count: Annotated[int, msgspec.Meta(ge=0)]
    returns: list[float]
    num_frames: int | None = None  # which the weights do not always determine
    held_out: list[HeldOut] = field(default_factory=list)


def _record_state(state: Mapping[str, Any], recipe: Recipe) -> _RecordState:
    """Reads the state of a record.

    Raises:
        ValueError: if it is not one, or the recipe's network now reads another number of frames.
    """
    record, num_frames = msgspec.convert(state, _RecordState), recipe.backbone.num_frames
    if record.num_frames not in (None, num_frames):
        raise ValueError(f"num_frames is {num_frames}, but it was trained with {record.num_frames}")
    return record


def load_trained(
    run: Run, recipe: Recipe | None = None, *, best: bool = False
) -> tuple[int, Algorithm[Any], Any]:
    """Loads the networks of a run's newest checkpoint.

    Args:
        run: a run folder with a checkpoint.
        recipe: the run's recipe, if some of its settings are overridden.
        best: whether to load the weights with the highest return so far (see
            :class:`~recipes.core.best.Best`) instead of the last ones.

    Returns:
        The steps that it was trained for, the algorithm with its weights, and the whole checkpoint.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if the checkpoint has no best weights yet.
    """
    step, state = run.load_trained()
    step, algorithm = _load_networks(run, recipe or run.recipe, step, state, best=best)
    return step, algorithm, state


def _load_networks(
    run: Run, recipe: Recipe, step: int, state: dict[str, Any], *, best: bool
) -> tuple[int, Algorithm[Any]]:
    """Builds an algorithm with the weights of a checkpoint; returns their step, and it."""
    torch.set_num_threads(recipe.threads)
    algorithm = make_algorithm(recipe)
    with run.restoring(step):
        weights = state["networks"]
        if best:
            step, weights = state["best"]["step"], state["best"]["networks"]
    if step is None:
        raise ValueError(
            f"{run.folder} has no best weights yet: fewer than {EPISODES} training episodes ended, "
            "or none was evaluated; evaluate the last ones (without --best)"
        )
    with run.restoring(step):
        load_weights(algorithm.model, weights)
    algorithm.policy.eval()  # without dropout
    return step, algorithm


def evaluate(
    run: Run,
    recipe: Recipe | None = None,
    callbacks: Sequence[Callback] = (),
    *,
    best: bool = False,
) -> dict[str, Any]:
    """Evaluates a run's newest checkpoint: full episodes, the most likely action, raw rewards.

    Episodes already played with these weights and seeds are not played again. But the best weights
    are those whose evaluation in training was luckiest, so they play new episodes, whose seeds come
    after those of these evaluations. Without an environment, the weights are measured on the
    held-out episodes, by which the best ones were chosen.

    Args:
        run: a run folder with a checkpoint.
        recipe: the run's recipe, if some of its settings are overridden.
        callbacks: hooks that are given the outcomes.
        best: whether to evaluate the best weights of the checkpoint instead of the last ones.

    Returns:
        The entries of :func:`~recipes.core.evaluation.summarize`, the "seed" of the first episode,
        and which "weights" were evaluated: "last" or "best".

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if the checkpoint has no best weights yet.
        FloatingPointError: if a reward is NaN or infinite.
    """
    recipe = recipe or run.recipe
    step, state = run.load_trained()
    with run.restoring(step):
        record = _record_state(state["record"], recipe)
    outcomes = record.outcomes
    if best:
        recipe = replace(recipe, evaluation_seed=_fresh_seed(recipe, record))
        outcomes = []  # by which the weights were chosen
    step, algorithm = _load_networks(run, recipe, step, state, best=best)
    recipe = algorithm.recipe
    same_seed = record.evaluation_seed == recipe.evaluation_seed
    targets: list[float | None] = [*recipe.target_columns] or [None]
    now = [
        outcome
        for outcome in outcomes
        if outcome.step == step
        and same_seed
        and len(outcome.returns) == recipe.evaluation_episodes
        and outcome.target_return in targets
    ]
    if recipe.env and len(now) < len(targets):
        episodes = len(targets) * recipe.evaluation_episodes
        with (
            tqdm.tqdm(total=episodes, unit=" episodes", desc="evaluation", delay=1) as progress,
            watching_episodes(progress.update),
            naming(f"in {recipe.env}"),
        ):
            now = algorithm.play(step)
    known = (held_out for held_out in record.held_out if held_out.step == step)
    held_out = next(known, None) or algorithm.measure(step)
    for callback in callbacks if now else ():
        callback.evaluated(step, now)
    return {
        **summarize(now, outcomes, recipe, held_out),
        "seed": recipe.evaluation_seed,
        "weights": "best" if best else "last",
    }


def _fresh_seed(recipe: Recipe, record: _RecordState) -> int:
    """The recipe's evaluation seed, or the first one after those of the evaluations in training."""
    used = max((len(outcome.returns) for outcome in record.outcomes), default=0)
    first, end = recipe.evaluation_seed, record.evaluation_seed + used
    overlaps = first < end and record.evaluation_seed < first + recipe.evaluation_episodes
    return end if overlaps else first


def _naming(where: str, saved_step: int) -> AbstractContextManager[None]:
    """Adds the place and the last good checkpoint to the message of a FloatingPointError."""
    saved = f"the checkpoint of step {saved_step} is good" if saved_step else "none was saved"
    return naming(f"{where}; {saved}")


def _save(run: Run, step: int, parts: Mapping[str, Stateful]) -> None:
    state = {name: part.state_dict() for name, part in parts.items()}
    run.save(step, {**state, "rng": global_rng_state()})
    return_free_memory()


def _load(run: Run, parts: Mapping[str, Stateful]) -> None:
    """Loads the newest checkpoint if there is one."""
    loaded = run.load()
    if loaded is None:
        return
    step, state = loaded
    with run.restoring(step):
        for name, part in parts.items():
            _load_part(part, state[name])
        set_global_rng_state(state["rng"])


def _load_part(part: Stateful, state: dict[str, Any]) -> None:
    if isinstance(part, torch.optim.Optimizer):
        # Hyperparameters come from the recipe, which may have changed; only counters are restored.
        groups = zip(state["param_groups"], part.state_dict()["param_groups"], strict=True)
        kept = [{**own, **{k: saved[k] for k in saved if k == "step"}} for saved, own in groups]
        state = {**state, "param_groups": kept}
        _check_moments(part, state["state"])
    if isinstance(part, nn.Module):
        load_weights(part, state)
    else:
        part.load_state_dict(state)


def _check_moments(optimizer: torch.optim.Optimizer, state: Mapping[int, Any]) -> None:
    """Raises ValueError if an optimizer's state has another shape or dtype than its weight."""
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for index, kept in state.items():
        for name, value in kept.items():
            like = weights[index]
            if value.ndim and (value.shape, value.dtype) != (like.shape, like.dtype):
                raise ValueError(
                    f"{name} of weight {index} is {value.dtype} {list(value.shape)}, not "
                    f"{like.dtype} {list(like.shape)}"
                )
