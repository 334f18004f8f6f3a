"""The training loop, around an algorithm of one weight."""

from __future__ import annotations

import errno
import math
import os
import random
import shutil
import signal
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import nn

from recipes.core import runner
from recipes.core.algorithm import Algorithm, NotFiniteError, check_finite
from recipes.core.callback import Callback
from recipes.core.evaluation import Outcome
from recipes.core.metrics import read_metrics
from recipes.core.recipe import Recipe
from recipes.core.run import Run
from recipes.core.runner import evaluate, load_trained
from tests.recipes.small import assert_same_run, train
from tests.recipes.states import assert_same
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint
from torchrl_tit.settings.networks import mlp


@dataclass(frozen=True, kw_only=True)
class Toy(Recipe):
    algorithm: ClassVar[str] = "toy"

    total_steps: int = 24
    batch: int = 1
    learning_rate: float = 0.1
    bad_step: int = 0
    bad_value: str = "nan"
    evaluation_interval: int = 10

    def build(self) -> ToyAlgorithm:
        return ToyAlgorithm(self)

    @property
    def final_step(self) -> int:
        return self.total_steps

    def evaluation_due(self, before: int, step: int) -> bool:
        return step % self.evaluation_interval == 0


class ToyAlgorithm(Algorithm[Toy]):
    """Adds noise of every generator to one weight; a batch is the number of its first step."""

    columns = ("weight", "rare")
    optional_columns = ("rare",)
    log: ClassVar[list[Any]] = []

    def __init__(self, recipe: Toy) -> None:
        super().__init__(recipe)
        self.model = self.weight = nn.Linear(1, 1, bias=False)

    @property
    def policy(self) -> Any:
        return self.weight

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> Any:
        raise NotImplementedError

    def prepare(self, step: int, folder: Path) -> None:
        self.optimizer = torch.optim.Adam(self.weight.parameters(), lr=self.recipe.learning_rate)
        self.log.append(("prepare", step, folder))
        self.first = step // self.recipe.batch

    def batches(self) -> Any:
        return count(self.first)

    def size(self, batch: int) -> int:
        return self.recipe.batch

    def returns(self, batch: int) -> torch.Tensor:
        return torch.arange(batch % 3, dtype=torch.float32)  # of 0, 1 or 2 episodes

    def update(self, batch: int, step: int) -> dict[str, Any]:
        self.log.append(("update", step))
        noise = torch.rand(1, 1) + random.random() + float(np.random.rand())
        self.optimizer.zero_grad()
        self.weight(noise).sum().backward()
        self.optimizer.step()
        value = self.weight.weight.detach().squeeze()
        if step == self.recipe.bad_step and step:
            if self.recipe.bad_value == "inf":  # found at once
                check_finite(["weight"], torch.tensor([math.inf]))
            value = torch.tensor(float(self.recipe.bad_value))  # left to the loop
        self.log.append(("weight", value.item()))
        return {"rare": math.nan, "weight": value}

    def state(self) -> dict[str, Any]:
        return {"optimizer": self.optimizer}

    def play(self, step: int) -> list[Outcome]:
        self.log.append(("play", step))
        return [Outcome(step, [float(step + i) for i in range(self.recipe.evaluation_episodes)])]

    def close(self) -> None:
        self.log.append(("close",))


SMALL = Toy(
    name="toy",
    env="CartPole-v1",
    backbone=mlp(),
    log_interval=5,
    checkpoint_interval=4,
    evaluation_episodes=2,
)


@pytest.fixture(autouse=True)
def log():
    ToyAlgorithm.log.clear()
    return ToyAlgorithm.log


HOOKS = ("collected", "updated", "evaluated", "logged", "saving", "saved")


def steps_of(run: Run) -> list[int]:
    return [int(row["step"]) for row in read_metrics(run.folder / "metrics.csv")]


class Hooks(Callback):
    """Writes down which hook was called, with which step; acts when it has seen some update."""

    def __init__(self, at: int = 0, act: Any = lambda: False, name: str = "", calls: Any = None):
        self.at, self.act, self.name = at, act, name
        self.calls: list[Any] = [] if calls is None else calls

    def collected(self, step, batch):
        self.calls.append((self.name, "collected", step))

    def updated(self, step, policy):
        self.calls.append((self.name, "updated", step))
        return step == self.at and bool(self.act())

    def evaluated(self, step, outcomes):
        self.calls.append((self.name, "evaluated", step, outcomes[0].returns))

    def logged(self, step, row):
        self.calls.append((self.name, "logged", step, row["step"]))

    def saving(self, step):
        self.calls.append((self.name, "saving", step))

    def saved(self, step):
        self.calls.append((self.name, "saved", step))


def interrupt(times: int = 1, error: Exception | None = None) -> None:
    for _ in range(times):
        os.kill(os.getpid(), signal.SIGINT)
    if error is not None:
        raise error


@pytest.mark.parametrize(
    ("batch", "rows", "saved"),
    [
        (1, [5, 10, 15, 20], [4, 8, 10, 12, 16, 20, 24]),
        # Steps come in threes: what falls within a batch is done at its end.
        (3, [6, 12, 15, 21], [6, 9, 12, 18, 21, 24]),
    ],
)
def test_rows_evaluations_and_checkpoints_come_at_their_steps(tmp_path, batch, rows, saved, log):
    hooks = Hooks()
    run = train(replace(SMALL, batch=batch), tmp_path / "run", hooks)
    assert steps_of(run) == rows
    of = {name: [call[2] for call in hooks.calls if call[1] == name] for name in HOOKS}
    ends = list(range(batch, 25, batch))
    assert of["collected"] == of["updated"] == ends
    assert of["logged"] == rows
    assert of["saving"] == of["saved"] == saved
    assert of["evaluated"] == [step for step in ends if step % 10 == 0]
    assert [entry[1] for entry in log if entry[0] == "play"] == of["evaluated"]
    assert [entry[1] for entry in log if entry[0] == "update"] == [end - batch for end in ends]
    assert log[0] == ("prepare", 0, tmp_path / "run")
    assert log[-1] == ("close",)


def test_rows_hold_means_and_episodes_since_the_last(tmp_path, log):
    rows = read_metrics(train(SMALL, tmp_path / "run").folder / "metrics.csv")
    first = ["step", "time", "steps_per_second", "return_mean", "episodes"]
    assert list(rows[0]) == [*first, *ToyAlgorithm.columns]
    # Batches 0 to 4 end with 0, 1, 2, 0, 1 episodes, which return 0; 0, 1; 0.
    assert (rows[0]["episodes"], rows[0]["return_mean"]) == (4, 0.25)
    weights = [entry[1] for entry in log if entry[0] == "weight"]
    for row, begin in zip(rows, (0, 5, 10, 15), strict=True):
        assert row["weight"] == pytest.approx(sum(weights[begin : begin + 5]) / 5)
    assert all(math.isnan(row["rare"]) for row in rows)  # an optional column


@pytest.mark.parametrize("stop", [3, 7, 10, 20])
def test_a_run_that_was_interrupted_resumes_bit_for_bit(tmp_path, stop):
    whole = train(SMALL, tmp_path / "whole")
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(SMALL, tmp_path / "run", Hooks(stop, interrupt))
    assert signal.getsignal(signal.SIGINT) is handler
    assert ToyAlgorithm.log[-1] == ("close",)
    assert checkpoint_steps(tmp_path / "run" / "checkpoints")[-1] == stop
    torch.manual_seed(123)  # the resuming process may be in any state
    random.seed(123)
    np.random.seed(123)
    ToyAlgorithm.log.clear()
    resumed = train(SMALL, tmp_path / "run")
    assert ToyAlgorithm.log[:2] == [("prepare", stop, tmp_path / "run"), ("update", stop)]
    state, expected = (load_checkpoint(run.checkpoints)[1] for run in (resumed, whole))
    for name in ("networks", "optimizer", "rng"):
        assert_same(state[name], expected[name])
    weights = [
        [str(row["weight"]) for row in read_metrics(run.folder / "metrics.csv")]
        for run in (resumed, whole)
    ]
    assert weights[0] == weights[1]


def test_a_run_that_is_trained_is_not_trained_further(tmp_path):
    whole = train(SMALL, tmp_path / "run")
    ToyAlgorithm.log.clear()
    again = train(SMALL, tmp_path / "run")
    assert [entry[0] for entry in ToyAlgorithm.log] == ["prepare", "close"]
    assert_same_run(again, whole)


def test_a_resumed_optimizer_has_the_recipes_settings_and_its_own_counters(tmp_path):
    train(SMALL, tmp_path / "run")
    longer = replace(SMALL, total_steps=25, learning_rate=0.03)
    state = load_checkpoint(train(longer, tmp_path / "run").checkpoints)[1]["optimizer"]
    assert state["param_groups"][0]["lr"] == 0.03
    assert state["state"][0]["step"].item() == 25


def test_a_disk_that_is_full_at_any_write_loses_nothing(tmp_path, monkeypatch):
    """Each write of a run fails once; the error names the file, and the run then goes on."""
    recipe = replace(SMALL, total_steps=10)
    fsync, written, limit = os.fsync, 0, 10**6

    def until_full(descriptor):
        nonlocal written
        if written >= limit:
            raise OSError(errno.ENOSPC, "No space left on device")
        written += 1
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", until_full)
    whole = train(recipe, tmp_path / "whole")
    writes = written
    assert writes > 20
    for number in range(writes):
        folder, written, limit = tmp_path / str(number), 0, number
        with pytest.raises(OSError, match=rf"No space left on device.*{folder}|{folder}.*No space"):
            train(recipe, folder)
        limit = 10**6
        if not (folder / "recipe.json").exists():
            Run.create(folder, recipe)
        assert_same_run(train(recipe, folder), whole)
        assert not [path for path in folder.rglob("*") if ".tmp" in path.name]
        shutil.rmtree(folder)


@pytest.mark.parametrize("act", [lambda: interrupt(2), lambda: interrupt(1, RuntimeError("g++"))])
def test_a_second_ctrl_c_or_an_error_that_it_brings_about_stops_at_once(tmp_path, act):
    """A compiler that the batch runs is stopped by the same Ctrl-C."""
    with pytest.raises(KeyboardInterrupt):
        train(SMALL, tmp_path / "run", Hooks(6, act))
    assert checkpoint_steps(tmp_path / "run" / "checkpoints") == [4]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_callback_ends_the_training_at_a_checkpoint_and_says_so_in_the_bar(tmp_path, capsys):
    callback = Hooks(7, lambda: True)
    callback.last_step = 8
    run = train(SMALL, tmp_path / "run", callback, Hooks())
    assert "/8 " in capsys.readouterr().err
    assert checkpoint_steps(run.checkpoints)[-1] == 7
    assert ToyAlgorithm.log[-1] == ("close",)


def test_a_finished_run_is_trained_further_as_if_it_had_been_that_long(tmp_path):
    long = train(replace(SMALL, total_steps=40), tmp_path / "long")
    run = train(SMALL, tmp_path / "run")
    with run, pytest.raises(ValueError, match=r"total_steps 23 ends at .* trained for 24 steps"):
        run.lengthen(23)
    assert run.recipe == SMALL
    with run:
        run.lengthen(40)
        runner.train(run.recipe, run)
    assert (run.folder / "recipe.json").read_text() == (long.folder / "recipe.json").read_text()
    assert_same_run(run, long)


@pytest.mark.parametrize("value", ["inf", "nan"])
@pytest.mark.parametrize(("bad_step", "found", "saved"), [(1, 4, 0), (9, 10, 8), (23, 24, 20)])
def test_what_is_not_finite_is_neither_logged_nor_saved(tmp_path, value, bad_step, found, saved):
    """Found by the update itself, or by the loop before the next row and the next checkpoint."""
    recipe = replace(SMALL, bad_step=bad_step, bad_value=value)
    at = bad_step + 1 if value == "inf" else found
    good = f"the checkpoint of step {saved} is good" if saved else "none was saved"
    message = rf"^weight became {value} in the update at step {at}; {good}$"
    with pytest.raises(NotFiniteError, match=message):
        train(recipe, tmp_path / "run")
    run = Run(tmp_path / "run", recipe)
    assert ([0, *checkpoint_steps(run.checkpoints)])[-1] == saved
    assert all(step <= bad_step for step in steps_of(run))
    assert ToyAlgorithm.log[-1] == ("close",)


def test_evaluations_are_played_once(tmp_path):
    run = train(replace(SMALL, total_steps=20), tmp_path / "run")
    log = ToyAlgorithm.log
    log.clear()
    result = evaluate(run)
    assert log == []
    assert (result["returns"], result["steps"], result["seed"]) == ([20, 21], 20, 1_000_000)
    assert (result["mean"], result["episodes"]) == (20.5, 2)
    evaluate(run, replace(run.recipe, evaluation_seed=1))
    assert evaluate(run, replace(run.recipe, evaluation_episodes=3))["returns"] == [20, 21, 22]
    assert log == [("play", 20)] * 2


def test_the_best_weights_play_new_episodes(tmp_path):
    """Their evaluation in training chose them: its episodes and its return do not count."""
    run = train(replace(SMALL, total_steps=22), tmp_path / "run")
    ToyAlgorithm.log.clear()
    best = evaluate(run, best=True)
    assert ToyAlgorithm.log == [("play", 20)]
    assert (best["steps"], best["seed"], best["weights"]) == (20, 1_000_002, "best")
    for seed, expected in ((999_999, 1_000_002), (1_000_001, 1_000_002), (1_000_002, 1_000_002)):
        chosen = replace(run.recipe, evaluation_seed=seed)
        assert evaluate(run, chosen, best=True)["seed"] == expected
    assert evaluate(run, replace(run.recipe, evaluation_seed=5), best=True)["seed"] == 5


def test_evaluations_choose_the_best_weights_as_soon_as_there_are_any(tmp_path, monkeypatch):
    """Until then, training episodes do, whose returns are not compared with evaluations."""
    monkeypatch.setattr(ToyAlgorithm, "returns", lambda self, batch: torch.full((20,), 1000.0))
    run = train(SMALL, tmp_path / "run", Hooks(7, lambda: True))
    assert load_trained(run, best=True)[0] == 6
    run = train(SMALL, tmp_path / "run")
    best = load_checkpoint(run.checkpoints)[1]["best"]
    assert (best["step"], best["return_mean"]) == (20, 20.5)
