"""Runs of several seeds side by side, in one update."""

from __future__ import annotations

import json
import os
import shutil
import signal
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
import torch

from recipes.cli import main
from recipes.cql import CQL
from recipes.metrics import read_metrics
from recipes.offline.side_by_side import common_step
from recipes.offline.state import TrainingState
from recipes.recipe import recipe_to_json
from recipes.run import Run
from tests.recipes.cql.cql_runs import make_cql
from tests.recipes.offline.sequence_runs import assert_same, train, without_time
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint
from torchrl_tit.networks import MLPConfig

SEEDS = (3, 0)


def train_seeds(recipe, folder, seeds=SEEDS):
    runs = [Run.create(folder / f"seed-{seed}", replace(recipe, seed=seed)) for seed in seeds]
    go_on(runs)
    return runs


def go_on(runs):
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run)
        runs[0].recipe.train_side_by_side(runs)


def rows_of(run):
    return [without_time(row) for row in read_metrics(run.folder / "metrics.csv")]


def shapes(state):
    """A state with what tensors look like instead of what is in them."""
    if isinstance(state, dict):
        return {key: shapes(value) for key, value in state.items()}
    return (state.shape, state.dtype) if isinstance(state, torch.Tensor) else type(state)


def test_each_is_the_run_that_it_is_alone(tmp_path, monkeypatch):
    """Without randomness in the update; weights at the start and batches are those of the seed."""
    recipe = make_cql(tmp_path, backbone=MLPConfig(), actor_learning_rate=1e-3)
    monkeypatch.setattr(
        "torch.distributions.normal._standard_normal",
        lambda shape, dtype, device: torch.full(shape, 0.3, dtype=dtype),
    )
    monkeypatch.setattr(torch, "rand", lambda *shape, **_: torch.full(shape, 0.2))
    runs = train_seeds(recipe, tmp_path)
    weights = []
    for run in runs:
        alone = train(run.recipe, tmp_path / f"alone-{run.recipe.seed}")
        (step, state), (_, expected) = map(load_checkpoint, (run.checkpoints, alone.checkpoints))
        assert step == 18
        assert shapes(state) == shapes(expected)
        assert_same(state["buffer"], expected["buffer"])
        torch.testing.assert_close(state["agent"], expected["agent"], rtol=1e-4, atol=2e-6)
        for name in ("temperature_optimizer", "critic_optimizer", "actor_optimizer"):
            assert_same(state[name]["param_groups"], expected[name]["param_groups"])
            torch.testing.assert_close(
                state[name]["state"], expected[name]["state"], rtol=1e-3, atol=1e-4
            )
        rows = [read_metrics(one.folder / "metrics.csv") for one in (run, alone)]
        for row, other in zip(*rows, strict=True):
            for name in row.keys() - {"time"}:
                assert row[name] == pytest.approx(other[name], rel=1e-3, abs=1e-4, nan_ok=True)
        weights.append(state["agent"]["log_alpha"])
    assert weights[0] != weights[1]


def test_resumes_bit_for_bit(tmp_path):
    """Also from what a kill leaves while the runs are saved one after the other."""
    recipe = make_cql(tmp_path, critic="backbone", history=3)
    whole = train_seeds(recipe, tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    runs = [Run.open(tmp_path / "cut" / f"seed-{seed}") for seed in SEEDS]
    shutil.rmtree(runs[1].checkpoints / f"{18:012d}")
    assert [checkpoint_steps(run.checkpoints)[-1] for run in runs] == [18, 16]
    assert common_step(runs) == 16
    torch.manual_seed(123)  # where the process that resumes happens to be
    go_on(runs)
    for run, other in zip(runs, whole, strict=True):
        assert_same(load_checkpoint(run.checkpoints), load_checkpoint(other.checkpoints))
        assert rows_of(run) == rows_of(other)


def test_goes_on_alone_and_side_by_side_again(tmp_path):
    recipe = make_cql(tmp_path, total_updates=4)
    runs = train_seeds(recipe, tmp_path)
    for run in runs:
        with run:
            run.recipe = replace(run.recipe, total_updates=8)
            run.recipe.train(run)
    for run in runs:
        run.recipe = replace(run.recipe, total_updates=12)
    before = [load_checkpoint(run.checkpoints)[1] for run in runs]
    go_on(runs)
    for run, state in zip(runs, before, strict=True):
        step, after = load_checkpoint(run.checkpoints)
        assert step == 12
        assert shapes(after) == shapes(state) | {"outcomes": list}
        for name in ("temperature_optimizer", "critic_optimizer", "actor_optimizer"):
            assert {s["step"].item() for s in after[name]["state"].values()} == {12}


def test_command_line(tmp_path, capsys, monkeypatch):
    """Stopped, gone on with, evaluated and put together like other runs."""
    path = tmp_path / "recipe.json"
    path.write_text(recipe_to_json(make_cql(tmp_path)))
    add = TrainingState.add
    sent: list[int] = []

    def stop_at_seventh(state, terms):
        add(state, terms)
        if state.saved_step == 4 and state._count == 2 and not sent:
            sent.append(signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    out = tmp_path / "runs"
    monkeypatch.setattr(TrainingState, "add", stop_at_seventh)
    with pytest.raises(SystemExit) as stop:
        main(f"train {path} --seeds 3 0 --history 2 --out {out}".split())
    monkeypatch.undo()
    assert stop.value.code == 130
    folders = [out / "seed-3", out / "seed-0"]
    assert [checkpoint_steps(folder / "checkpoints")[-1] for folder in folders] == [7, 7]
    command = f"train --resume {folders[0]} {folders[1]}"
    assert command in capsys.readouterr().err
    main(command.split())
    printed = capsys.readouterr().out
    assert printed.count("over 3 episodes after 18 steps") == 2
    for seed, folder in zip(SEEDS, folders, strict=True):
        run = Run.open(folder)
        assert isinstance(run.recipe, CQL)
        assert (run.recipe.seed, run.recipe.history) == (seed, 2)
        assert run.is_complete()
        rows = read_metrics(folder / "metrics.csv")
        assert [row["step"] for row in rows] == [5, 9, 10, 15, 18]
        evaluation = json.loads((folder / "evaluation.json").read_text())
        assert np.mean(evaluation["returns"]) == rows[-1]["return_mean"]
        agent = run.recipe.load_agent(run)[1]
        assert agent.play(3, run.recipe.evaluation_seed).tolist() == evaluation["returns"]
    main(command.split())
    assert capsys.readouterr().out.count("is complete") == 2
    main(["table", str(out)])
    assert "| cql/hopper/small | 2 |" in capsys.readouterr().out


def test_a_loss_that_is_not_finite_is_named_with_its_seed(tmp_path, monkeypatch):
    recipe = make_cql(tmp_path)
    make_agent = CQL.make_agent

    def poison(self):
        agent = make_agent(self)
        if self.seed == 0:
            agent.loss.log_alpha.data.fill_(torch.nan)
        return agent

    monkeypatch.setattr(CQL, "make_agent", poison)
    message = "^loss_alpha of seed 0 became nan in the update at step 4; none was saved"
    with pytest.raises(FloatingPointError, match=message):
        train_seeds(recipe, tmp_path)


def refused(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    return capsys.readouterr().err


def test_what_cannot_be_trained_together_is_refused_before_anything_is_written(tmp_path, capsys):
    path = tmp_path / "recipe.json"
    path.write_text(recipe_to_json(make_cql(tmp_path)))
    out = tmp_path / "runs"
    words = ["train", str(path), "--out", str(out), "--seeds"]
    assert "error: seed 1 is there twice" in refused([*words, "1", "2", "1"], capsys)
    assert "seed must be at least 0, not -1" in refused([*words, "1", "-1"], capsys)
    message = refused(["train", "ppo/cartpole/mlp", *words[2:], "0", "1"], capsys)
    assert "error: ppo recipes train one seed at a time: train them with sweep" in message
    assert not out.exists()
    (out / "seed-2").mkdir(parents=True)
    (out / "seed-2" / "notes.txt").touch()
    assert f"{out / 'seed-2'} exists already" in refused([*words, "1", "2"], capsys)
    assert not (out / "seed-1").exists()


def test_runs_that_do_not_fit_each_other_are_not_gone_on_with(tmp_path, capsys):
    recipe = make_cql(tmp_path, total_updates=1, checkpoint_interval=1)
    folders = [str(run.folder) for run in train_seeds(recipe, tmp_path)]
    other = replace(recipe, seed=1, gamma=0.5)
    with Run.create(tmp_path / "other", other):
        words = ["train", "--resume", folders[0], str(tmp_path / "other")]
        message = "error: the runs of seeds 3 and 1 differ in more than the seed: resume each alone"
        assert message in refused(words, capsys)
    with Run.open(tmp_path / "seed-3") as run:
        replace(recipe, seed=3, total_updates=7).train(run)
    message = f"cannot go on together: {folders[0]} 7, {folders[1]} 1"
    assert message in refused(["train", "--resume", *folders], capsys)
