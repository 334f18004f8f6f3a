"""The only training loop: batches, updates, metrics, evaluations, checkpoints, resume."""

from __future__ import annotations

import ctypes
import math
import random
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from torchrl_tit.checkpoint import checkpoint_steps, global_rng_state, set_global_rng_state
from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import watching_episodes
from torchrl_tit.modules.action_specs import describe

from .algorithm import Algorithm, Stateful, check_weights, load_weights, make_algorithm, naming
from .callback import Callback
from .evaluation import summarize
from .interrupt import Interrupt
from .metrics import Metrics
from .networks import name_chosen_encoders
from .numbers import number
from .optional import tqdm
from .progress import EPISODES, Best, Record, RecordState, read_state
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
    given, (recipe, _) = recipe, name_chosen_encoders(algorithm)
    step = saved_step = max(checkpoint_steps(run.checkpoints), default=0)
    if step == 0 and recipe != given:
        run.save_recipe(recipe)  # with what only its data say
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
        metrics = stack.enter_context(closing(Metrics(run.folder, record.columns, last_step=step)))
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
            at_random = before < getattr(recipe, "random_steps", 0)
            if returns is not None and not record.outcomes and not at_random:
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
                    if evaluation_due:
                        check_weights(algorithm.model)
            enough = any([callback.updated(step, algorithm.policy) for callback in callbacks])
            if evaluation_due:
                where = f"in {recipe.env}, in the evaluation at step {step}"
                with metrics.paused(), _naming(where, saved_step):
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
                    check_weights(algorithm.model)
                metrics.sync()  # the checkpoint's rows must be on the disk before it
                for callback in callbacks:
                    callback.saving(step)
                with metrics.paused():
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
        return f"return {number(row['return_mean'])}"
    known = {x: row[x] for x in algorithm.held_out_columns if not math.isnan(row[x])}
    words = [f"{name.removeprefix('held_out_')} {value:.3g}" for name, value in known.items()]
    return f"held out: {', '.join(words)}" if words else ""


def load_trained(
    run: Run, recipe: Recipe | None = None, *, best: bool = False
) -> tuple[int, Algorithm[Any], Any]:
    """Loads the networks of a run's newest checkpoint.

    Args:
        run: a run folder with a checkpoint.
        recipe: the run's recipe, if some of its settings are overridden.
        best: whether to load the weights with the highest return so far (see
            :class:`~recipes.core.progress.Best`) instead of the last ones.

    Returns:
        The steps that it was trained for, the algorithm with its weights, and the whole checkpoint.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if the checkpoint has no best weights yet.
    """
    step, state = run.load_trained()
    step, algorithm = load_networks(run, recipe or run.recipe, step, state, best=best)
    return step, algorithm, state


def load_networks(
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
            f"{run.folder} has no best weights yet: fewer than {EPISODES} training episodes ended "
            "(random actions do not count), or none was evaluated; take the last ones (without "
            "--best)"
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
        recipe: the run's recipe, if some of its settings are overridden, also its task: the policy
            stays as it was trained.
        callbacks: hooks that are given the outcomes.
        best: whether to evaluate the best weights of the checkpoint instead of the last ones.

    Returns:
        The entries of :func:`~recipes.core.evaluation.summarize`, the "seed" of the first episode,
        and which "weights" were evaluated: "last" or "best".

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if the checkpoint has no best weights yet, or another task has other
            observations or actions.
        FloatingPointError: if a reward is NaN or infinite.
    """
    recipe = recipe or run.recipe
    task = {"env": recipe.env, "env_settings": recipe.env_settings}
    own: dict[str, Any] = {name: getattr(run.recipe, name) for name in task}
    step, state = run.load_trained()
    with run.restoring(step):
        record = read_state(state["record"], recipe)
    outcomes = record.outcomes
    if best:
        recipe = with_fresh_seed(recipe, record)
    if best or task != own:
        outcomes = []  # by which the weights were chosen, or of another task
    step, algorithm = load_networks(run, replace(recipe, **own), step, state, best=best)
    if task != own:
        _change_task(algorithm, **task)
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


def _change_task(algorithm: Algorithm[Any], **task: Any) -> None:
    """Changes the task that a policy plays, whose networks stay as they were built.

    Raises:
        ValueError: if its observations or actions are others.
    """
    before = algorithm.recipe
    specs = []
    for recipe in (before, replace(before, **task)):
        algorithm.recipe = recipe
        with closing(algorithm.make_env(1)) as env:
            observation = observation_specs(env)
            named = observation if isinstance(observation, dict) else {"observation": observation}
            specs.append({**named, "action": env.action_spec_unbatched})
    own, new = specs
    for name in {**own, **new}:
        if own.get(name) != new.get(name):
            own_kind, kind = (describe(found[name]) if name in found else "none" for found in specs)
            raise ValueError(
                f"{algorithm.recipe.env} has the {name} {kind}, but the policy was trained in "
                f"{before.task_name} with {own_kind}: it can play only tasks that have the same"
            )


def with_fresh_seed(recipe: Recipe, record: RecordState) -> Recipe:
    """Moves the evaluation seed behind those of the evaluations in training, if they overlap."""
    used = max((len(outcome.returns) for outcome in record.outcomes), default=0)
    first, end = recipe.evaluation_seed, record.evaluation_seed + used
    overlaps = first < end and record.evaluation_seed < first + recipe.evaluation_episodes
    return replace(recipe, evaluation_seed=end if overlaps else first)


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
            if name not in state:
                raise ValueError(f"it has no state of the part {name}")
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


def return_free_memory() -> None:
    """Returns freed memory to the system, where the C library is glibc; elsewhere does nothing.

    Between two blocks that are in use, glibc keeps what was freed, and a run that frees and
    allocates tensors of changing sizes grows for hours although it uses no more. See
    ``man 3 malloc_trim``.

    Example:
        >>> return_free_memory()
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
