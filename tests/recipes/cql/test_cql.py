"""Recipes of conservative Q-learning: training, resuming and evaluation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recipes.core.metrics import read_metrics
from recipes.core.runner import evaluate
from recipes.cql import DiscreteCQL
from tests.datasets.rollouts import write
from tests.recipes.cql.cql_runs import make_algorithm, make_cql, make_discrete_cql, roll_pong, tit
from tests.recipes.dataset_runs import assert_resumes_bit_for_bit, train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings.networks import lstm, mlp

CQL_TERMS = ["loss_alpha", "loss_qvalue", "loss_cql", "loss_actor", "alpha", "entropy"]
DISCRETE_TERMS = ["loss_qvalue", "loss_cql", "value"]


def assert_trains(recipe, folder, terms):
    """Trains, with evaluations and metrics; returns the rows and the weights."""
    make_algorithm(recipe).check()
    run = train(recipe, folder / "run")
    rows = read_metrics(run.folder / "metrics.csv")
    assert [row["step"] for row in rows] == [5, 9, 10, 15, 18]
    assert list(rows[0]) == ["step", "time", "steps_per_second", "return_mean", *terms]
    for row in rows:  # an evaluation between two rows has one of its own
        assert all(np.isfinite(row[term]) == (row["step"] not in (9, 18)) for term in terms)
    assert [row["step"] for row in rows if np.isfinite(row["return_mean"])] == [9, 18]
    step, state = load_checkpoint(run.checkpoints)
    assert step == 18
    # Everything that is trained is in there.
    make_algorithm(recipe).model.load_state_dict(state["networks"])
    return rows, state["networks"]


@pytest.mark.parametrize(
    "settings",
    [
        {"backbone": mlp(hidden_dim=16, activation="relu")},
        {"backbone": tit(4), "critic": "backbone", "over_critics": "sum"},
        {"backbone": lstm(4, embed_dim=8, hidden_dim=8), "critic": "backbone"},
        {"backbone": tit(4), "critic": "backbone", "slice_length": 4},
    ],
    ids=["mlp", "backbone", "lstm-4", "slices"],
)
def test_continuous_actions(tmp_path, settings):
    recipe = make_cql(tmp_path, **settings)
    rows, weights = assert_trains(recipe, tmp_path, CQL_TERMS)
    assert rows[-1]["alpha"] != 1.0
    torch.manual_seed(recipe.seed)
    untrained = make_algorithm(recipe).model.state_dict()
    trained = {n for n, w in weights.items() if not torch.equal(w, untrained[n])}
    networks = {name.partition("_params")[0] for name in trained}
    assert networks == {"actor_network", "qvalue_network", "target_qvalue_network", "log_alpha"}
    backbones = any("history_encoder" in name for name in trained if "qvalue_network" in name)
    assert backbones == (recipe.critic == "backbone")
    online, target = (
        next(w for n, w in weights.items() if n.startswith(f"{name}_params"))
        for name in ("qvalue_network", "target_qvalue_network")
    )
    assert not torch.equal(online, target)


@pytest.mark.parametrize(("num_frames", "slice_length"), [(1, 1), (3, 4)])
def test_discrete_actions(tmp_path, num_frames, slice_length):
    recipe = make_discrete_cql(tmp_path, backbone=tit(num_frames), slice_length=slice_length)
    _, weights = assert_trains(recipe, tmp_path, DISCRETE_TERMS)
    online, target = (
        next(w for n, w in weights.items() if n.startswith(f"{name}_params"))
        for name in ("value_network", "target_value_network")
    )
    assert not torch.equal(online, target)


def test_images_of_a_game(tmp_path):
    recipe = make_discrete_cql(
        tmp_path,
        dataset=str(write(tmp_path / "pong.hdf5", roll_pong())),
        env="ALE/Pong-v5",
        env_settings=("max_num_frames_per_episode=400",),
        backbone=tit(4, patch_size=42),
        padding="constant",
        total_updates=4,
        evaluation_interval=4,
        evaluation_episodes=1,
        log_interval=2,
    )
    algorithm = make_algorithm(recipe)
    algorithm.check()
    batch = algorithm.make_buffer().sample()
    assert batch["history"].dtype is torch.uint8
    assert batch["history"].shape == (8, 4, 84, 84)
    run = train(recipe, tmp_path / "run")
    evaluation = evaluate(run)
    rows = read_metrics(run.folder / "metrics.csv")
    assert [row["step"] for row in rows] == [2, 4]
    assert -21 <= evaluation["mean"] <= 21
    # A game without reference returns counts as it is.
    assert evaluation["score"] == {"best": evaluation["mean"], "last": evaluation["mean"]}


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_resumes_bit_for_bit(tmp_path, make):
    settings = {"critic": "backbone"} if make is make_cql else {}
    assert_resumes_bit_for_bit(make(tmp_path, backbone=tit(4), **settings), tmp_path)


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_dropout_is_on_in_updates_and_off_in_evaluations(tmp_path, make, monkeypatch):
    recipe = make(tmp_path, **({"critic": "backbone"} if make is make_cql else {}))
    seen = set()
    forward = HistoryNetwork.forward

    def watch(network, history):
        modes = {module.training for module in network.modules()}
        seen.add(("update" if len(history) == recipe.batch_size else "evaluation", *modes))
        return forward(network, history)

    monkeypatch.setattr(HistoryNetwork, "forward", watch)
    train(recipe, tmp_path / "run")
    assert seen == {("update", True), ("evaluation", False)}
    algorithm = make_algorithm(recipe)
    batch = algorithm.make_buffer().sample()

    def loss():
        if isinstance(recipe, DiscreteCQL):
            return algorithm.model(batch.clone())["loss_qvalue"]
        return algorithm.model.actor_loss(samples)[0]  # through the critics

    samples = algorithm.model.sample_policy(batch) if make is make_cql else None
    assert loss() != loss()
    algorithm.policy.eval()
    if make is make_cql:
        algorithm.model.qvalue_network.eval()  # which the loss does not list among its modules
    assert loss() == loss()


def test_the_discrete_target_follows_the_trained_network_slowly(tmp_path):
    algorithm = make_algorithm(make_discrete_cql(tmp_path, tau=0.25))
    algorithm.prepare(0, tmp_path)
    loss = algorithm.model
    before = loss.target_value_network_params.data.clone()
    algorithm.update(next(algorithm.batches()), 0)
    trained, target = loss.value_network_params.data, loss.target_value_network_params
    for name, weight in target.data.items(True, True):
        if weight.is_floating_point():
            torch.testing.assert_close(weight, 0.75 * before[name] + 0.25 * trained[name])
    assert not (trained == before).all()
