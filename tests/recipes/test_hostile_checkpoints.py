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

from recipes.core import runner
from recipes.core.initial_weights import weights_from
from recipes.core.run import Run
from tests.recipes.commands import fails
from tests.recipes.small import TINY, train
from torchrl_tit.checkpoint import load_checkpoint


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    run = train(TINY, tmp_path_factory.mktemp("runs") / "run")
    return run.folder, load_checkpoint(run.checkpoints)[1]


@pytest.fixture
def run(trained, tmp_path) -> Run:
    """A copy of the run, which is to be trained further."""
    shutil.copytree(trained[0], tmp_path / "run")
    return Run(tmp_path / "run", replace(TINY, total_steps=192))


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
    "no weights": (lambda s: s["networks"].clear(), "does not fit"),
    "generators lost": (lambda s: s.pop("rng"), "rng"),
    "weights of another dtype": (change_weight(lambda w: w.double()), "float64, not torch.float32"),
    "weights that are no numbers": (change_weight(lambda w: w * torch.nan), "not finite"),
    "parts of an older version": (
        lambda s: s.pop("optimizer"),
        "(it has no state of the part optimizer): an older version of torchrl-tit made it, or",
    ),
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
    run.save(128, state)
    before = (run.folder / "metrics.csv").read_bytes()
    with run, pytest.raises(ValueError, match=r"checkpoint of step 128 .* does not fit") as error:
        runner.train(run.recipe, run)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)
    assert (run.folder / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize("state", ["networks", {"agent": {}}])
def test_what_an_older_version_wrote_is_no_state(state, run):
    run.save(128, state)
    for use in (lambda: runner.train(run.recipe, run), lambda: runner.evaluate(run)):
        with (
            run,
            pytest.raises(ValueError, match=r"step 128 in .* an older version"),
        ):
            use()


def test_weights_that_are_no_numbers_are_not_evaluated(run, trained, capsys):
    state = copy.deepcopy(trained[1])
    change_weight(lambda w: w * torch.nan)(state)
    run.save(128, state)
    before = sorted(path.name for path in run.folder.iterdir())
    for command in ("evaluate", "play"):
        assert "has entries that are not finite" in fails(capsys, command, run.folder)
    assert sorted(path.name for path in run.folder.iterdir()) == before
    with pytest.raises(ValueError, match=r"of .*run .* has entries that are not finite"):
        weights_from(run.folder, runner.make_algorithm(TINY))
