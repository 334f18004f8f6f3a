"""Checkpoints whose sums are right and whose inside is wrong: refused in one line."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from recipes.cli import main
from recipes.core import runner
from recipes.core.initial_weights import weights_from
from recipes.core.run import Run
from recipes.ppo import PPO
from torchrl_tit.checkpoint import CheckpointError, load_checkpoint
from torchrl_tit.settings.networks import mlp

STEPS = 32
RECIPE = PPO(
    name="ppo/cartpole/hostile",
    env="CartPole-v1",
    backbone=mlp(hidden_dim=4, num_layers=1),
    total_steps=STEPS,
    steps_per_batch=STEPS,
    minibatch_size=16,
    epochs=1,
    num_envs=2,
    evaluation_episodes=1,
    compile="off",
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("runs") / "run"
    with Run.create(folder, RECIPE) as run:
        runner.train(RECIPE, run)
    return folder, load_checkpoint(run.checkpoints)[1]


@pytest.fixture
def run(trained, tmp_path) -> Run:
    """A copy of the run, which is to be trained further."""
    shutil.copytree(trained[0], tmp_path / "run")
    return Run(tmp_path / "run", replace(RECIPE, total_steps=2 * STEPS))


def change_weight(change: Callable[[torch.Tensor], Any]) -> Callable[[dict[str, Any]], None]:
    def edit(state: dict[str, Any]) -> None:
        weights = state["networks"]
        name = next(iter(weights))
        weights[name] = change(weights[name])

    return edit


def change_moment(state: dict[str, Any]) -> None:
    kept = state["optimizer"]["state"][0]
    kept["exp_avg"] = kept["exp_avg"].double()


WRONG: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "generators lost": (lambda s: s.pop("rng"), "rng"),
    "weights of another dtype": (change_weight(lambda w: w.double()), "float64, not torch.float32"),
    "weights that are no numbers": (change_weight(lambda w: w * torch.nan), "not finite"),
    "moments of another dtype": (change_moment, "exp_avg of weight 0 is torch.float64"),
    "negative count of updates": (lambda s: s["record"].update(count=-1), "count"),
    "sums of nothing": (lambda s: s["record"].update(sums=[1.0]), "1 sums of 0 updates"),
    "returns of text": (lambda s: s["record"].update(returns="none"), "array"),
    "no returns": (lambda s: s["record"].update(outcomes=[{"step": 1, "returns": []}]), ">= 1"),
    "no best weights": (lambda s: s.update(best={}), "step"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_run_does_not_go_on_from_it(what, run, trained):
    edit, reason = WRONG[what]
    state = copy.deepcopy(trained[1])
    edit(state)
    run.save(STEPS, state)
    before = (run.folder / "metrics.csv").read_bytes()
    with run, pytest.raises(ValueError, match=r"checkpoint of step 32 .* does not fit") as error:
        runner.train(run.recipe, run)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)
    assert (run.folder / "metrics.csv").read_bytes() == before


def test_text_is_no_state(run):
    run.save(STEPS, "networks")
    with run, pytest.raises(CheckpointError, match=r"the checkpoint of step 32 in .* is from"):
        runner.train(run.recipe, run)


def test_weights_that_are_no_numbers_are_not_evaluated(run, trained, capsys):
    state = copy.deepcopy(trained[1])
    change_weight(lambda w: w * torch.nan)(state)
    run.save(STEPS, state)
    before = sorted(path.name for path in run.folder.iterdir())
    for command in ("evaluate", "play"):
        with pytest.raises(SystemExit) as exit_:
            main([command, str(run.folder)])
        assert exit_.value.code == 2
        printed = capsys.readouterr()
        assert "has entries that are not finite" in printed.err.splitlines()[-1]
        assert not printed.out
    assert sorted(path.name for path in run.folder.iterdir()) == before
    with pytest.raises(ValueError, match=r"of .*run .* has entries that are not finite"):
        weights_from(run.folder, runner.make_algorithm(RECIPE))
