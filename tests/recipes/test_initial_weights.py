"""Runs that start from the weights of another run."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from recipes.bc import BC
from recipes.cli import main, training
from recipes.core import runner
from recipes.core.algorithm import make_algorithm
from recipes.core.initial_weights import weights_from
from recipes.core.run import Run
from recipes.iql import IQL
from recipes.sac import SAC
from recipes.td3bc import TD3BC
from tests.recipes.commands import fails
from tests.recipes.small import TINY
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.datasets import episodes_from_arrays, write_hdf5
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import mlp


def network(**settings: int) -> Network:
    return replace(mlp(**settings), trunks="shared")


PPO = replace(TINY, name="ppo/pendulum/mlp", env="Pendulum-v1", backbone=network(hidden_dim=8))
TINY_SHARED = replace(TINY, backbone=PPO.backbone)
SOFT = SAC(name="sac/pendulum/mlp", env="Pendulum-v1", backbone=PPO.backbone, gamma=0.9)
BOUNDS = ("middle", "half_range")  # of the actions
LAYERS = [f"history_encoder.layers.{i}.{kind}" for i in (0, 2) for kind in ("weight", "bias")]


def begin(folder, recipe):
    """A run with a checkpoint, as if it had been trained for 64 steps; returns its weights."""
    torch.manual_seed(7)
    weights = make_algorithm(recipe).model.state_dict()
    Run.create(folder, recipe).save(64, {"networks": weights})
    return weights


def test_a_run_starts_from_the_weights_and_resumes_without_the_other_run(
    tmp_path, capsys, monkeypatch
):
    weights = begin(tmp_path / "other", PPO)
    monkeypatch.setattr(training, "_finish", lambda *_: None)
    words = ["train", str(tmp_path / "other" / "recipe.json"), "--learning-rate", "1e-30"]
    main([*words, "--out", str(tmp_path / "new"), "--init-from", str(tmp_path / "other")])
    names = [f"backbone.module.{name}" for name in LAYERS]
    assert {*names, "critic.module.weight"} < weights.keys()
    count = f"{len(weights)} of {len(weights)} tensors"
    line = f"initial weights: {count} from {tmp_path / 'other'} (ppo, step 64)\n"
    assert capsys.readouterr().out == line

    shutil.rmtree(tmp_path / "other")  # as if killed before the first checkpoint
    run = Run.open(tmp_path / "new")
    with run:
        runner.train(run.recipe, run)
    trained = load_checkpoint(run.checkpoints)[1]["networks"]
    assert trained.keys() == weights.keys()
    for name in weights:
        torch.testing.assert_close(trained[name], weights[name], rtol=0, atol=1e-20)


def test_what_does_not_fit_is_named(tmp_path):
    begin(tmp_path / "other", TINY_SHARED)
    other_task = replace(
        TINY_SHARED, env="Acrobot-v1", backbone=network(hidden_dim=8, num_layers=3)
    )
    weights, line = weights_from(tmp_path / "other", make_algorithm(other_task))
    start, missing, shapes = line.split("; ")
    assert start == f"initial weights: 5 of 10 tensors from {tmp_path / 'other'} (ppo, step 64)"
    assert sorted(weights) == [
        *sorted(f"backbone.module.{name}" for name in LAYERS if "0.weight" not in name),
        "critic.module.bias",
        "critic.module.weight",
    ]
    assert missing == (
        "missing there: backbone.module.history_encoder.layers.4.bias, "
        "backbone.module.history_encoder.layers.4.weight"
    )
    assert shapes == (
        "of other shapes: actor.module.0.module.bias [2] instead of [3], "
        "actor.module.0.module.weight [2, 8] instead of [3, 8], "
        "backbone.module.history_encoder.layers.0.weight [8, 4] instead of [8, 6]"
    )
    begin(tmp_path / "deep", other_task)
    unexpected = weights_from(tmp_path / "deep", make_algorithm(TINY_SHARED))[1].split("; ")[1]
    assert unexpected == missing.replace("missing there", "unexpected")


def test_of_another_algorithm_the_policys_backbone_is_taken(tmp_path):
    theirs = begin(tmp_path / "other", PPO)
    weights, line = weights_from(tmp_path / "other", make_algorithm(SOFT))
    assert line == f"initial weights: 4 of 4 tensors from {tmp_path / 'other'} (ppo, step 64)"
    assert len(weights) == 4
    for name, weight in weights.items():
        assert name.startswith("actor_network_params.")
        own = name[name.index("history_encoder") :]
        assert torch.equal(weight, theirs[f"backbone.module.{own}"])


def test_hyperparameters_are_the_recipes_own(tmp_path):
    theirs = begin(tmp_path / "other", SOFT)
    new = make_algorithm(replace(SOFT, gamma=0.5))
    weights, line = weights_from(tmp_path / "other", new)
    assert "log_alpha" in weights
    left = theirs.keys() - weights.keys()
    critics = ("qvalue_network_params", "target_qvalue_network_params")
    bounds = {f"{critic}.module.0.module.{name}" for critic in critics for name in BOUNDS}
    assert left == {"_value_estimator.gamma", "alpha_init", "_target_entropy", *bounds}
    assert ";" not in line


@pytest.mark.parametrize("make", [BC, IQL, TD3BC])
def test_the_bounds_of_actions_are_the_tasks_own(make, tmp_path):
    data = {scale: log(tmp_path / f"{scale}.hdf5", scale) for scale in (0.5, 6.0)}
    narrow, wide = (
        make(dataset=str(path), backbone=PPO.backbone, validation_fraction=0.5)
        for path in data.values()
    )
    theirs = begin(tmp_path / "other", narrow)
    algorithm = make_algorithm(wide)
    weights, line = weights_from(tmp_path / "other", algorithm)
    algorithm.model.load_state_dict({**algorithm.model.state_dict(), **weights})
    ends = ("_low", "_high")
    bounds = [value for name, value in algorithm.policy.named_buffers() if name.endswith(ends)]
    assert [value.abs().tolist() for value in bounds] == [[6, 6], [6, 6]]
    left = [name for name in theirs.keys() - weights.keys() if not name.endswith("gamma")]
    assert [x for x in left if not x.endswith(("_low", "_high", "_action", *BOUNDS))] == []
    assert ";" not in line


def log(path, scale):
    """Writes two episodes of four steps with actions of a scale."""
    draw = np.random.default_rng(0)
    actions = draw.uniform(-scale, scale, (8, 2))
    actions[0], actions[1], actions[4], actions[5] = scale, -scale, scale, -scale
    ends = np.arange(8) % 4 == 3
    observations = draw.normal(size=(8, 3))
    write_hdf5(episodes_from_arrays(observations, actions, draw.normal(size=8), ends), path)
    return path


def test_a_run_of_which_nothing_fits_is_refused(tmp_path, capsys):
    begin(tmp_path / "other", SOFT)
    wider = replace(PPO, backbone=network(hidden_dim=16))
    with pytest.raises(ValueError, match=r"^no weights of .*other \(sac, step 64\) fit these net"):
        weights_from(tmp_path / "other", make_algorithm(wider))
    Run.create(tmp_path / "wider", wider)
    words = ["train", str(tmp_path / "wider" / "recipe.json"), "--out", str(tmp_path / "new")]
    line = fails(capsys, *words, "--init-from", str(tmp_path / "other"))
    assert "of other shapes: backbone.module.history_encoder.layers.0.bias [8] instead of" in line
    assert not (tmp_path / "new").exists()


def test_statistics_of_other_observations_are_not_counted(tmp_path):
    """A count that is taken without its mean weighs a mean of 0, and a variance of 1."""
    seen = replace(PPO, normalize_observations=True)
    theirs = begin(tmp_path / "other", seen)
    statistics = {name for name in theirs if name.endswith((".count", ".mean", ".variance"))}
    assert len(statistics) == 3
    taken, _ = weights_from(tmp_path / "other", make_algorithm(seen))
    assert statistics < taken.keys()
    other = make_algorithm(replace(seen, env="MountainCarContinuous-v0"))
    taken, line = weights_from(tmp_path / "other", other)
    assert taken
    assert not statistics & taken.keys()
    assert "observation.mean [3] instead of [2]" in line
