"""Recipes of conservative Q-learning: training, resuming and evaluation."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from recipes.callback import Callback
from recipes.cli import main
from recipes.cql import CQL, DiscreteCQL
from recipes.metrics import read_metrics
from recipes.recipe_json import recipe_to_json
from recipes.run import Run
from recipes.runner import evaluate, load_trained
from recipes.runner import train as train_in
from tests.datasets.rollouts import roll, write
from tests.recipes.cql.cql_runs import make_algorithm, make_cql, make_discrete_cql, roll_pong, tit
from tests.recipes.dataset_runs import assert_resumes_bit_for_bit, assert_same_run, train
from tests.recipes.states import unchecked
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.datasets import normalized_score, normalized_spread
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings import Inner
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

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
        {"backbone": tit()},
        {"backbone": tit(4)},
        {"backbone": tit(4), "critic": "backbone", "over_critics": "sum"},
        {"backbone": lstm(4, embed_dim=8, hidden_dim=8), "critic": "backbone"},
        {"backbone": tit(4), "critic": "backbone", "slice_length": 4},
        {"backbone": mlp(4, hidden_dim=16), "slice_length": 4},
    ],
    ids=["mlp", "tit", "tit-4", "backbone", "lstm-4", "slices", "mlp-slices"],
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


@pytest.mark.parametrize(("num_frames", "slice_length"), [(1, 1), (3, 1), (3, 4)])
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


class Camera(gymnasium.Env):
    """Random images, and continuous actions."""

    observation_space = Box(0, 255, (8, 8), np.uint8)
    action_space = Box(-1, 1, (2,), np.float32)

    def _observe(self):
        return self.np_random.integers(0, 256, (8, 8), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), float(action.sum()), bool(self.np_random.random() < 0.2), False, {}


@pytest.fixture
def camera(tmp_path):
    gymnasium.register("Camera-v0", entry_point=lambda **_: Camera())
    data = write(tmp_path / "camera.hdf5", roll(100, max_episode_steps=5, task="Camera-v0"))
    yield {"env": "Camera-v0", "dataset": str(data), "backbone": tit(patch_size=4)}
    del gymnasium.registry["Camera-v0"]


def test_images_and_continuous_actions(tmp_path, camera):
    assert_trains(make_cql(tmp_path, critic="backbone", **camera), tmp_path, CQL_TERMS)
    with pytest.raises(ValueError, match=r"cannot value images \(8, 8\): set critic to 'backbone'"):
        make_algorithm(make_cql(tmp_path, critic="mlp", **camera))


def test_evaluation(tmp_path):
    recipe = make_cql(tmp_path)
    run = train(recipe, tmp_path / "run")
    rows = read_metrics(run.folder / "metrics.csv")
    played = [row["return_mean"] for row in rows if np.isfinite(row["return_mean"])]
    evaluation = evaluate(run)
    other = evaluate(run, replace(recipe, evaluation_seed=5, evaluation_episodes=2))
    assert evaluation["mean"] == np.mean(evaluation["returns"]) == played[-1]
    assert evaluation["std"] == pytest.approx(np.std(evaluation["returns"]))
    assert evaluation["score_std"] == pytest.approx(normalized_spread(evaluation["std"], "hopper"))
    assert evaluation["score"] == pytest.approx(
        {
            "best": normalized_score(max(played), "hopper"),
            "last": normalized_score(played[-1], "hopper"),
        }
    )
    assert (evaluation["episodes"], evaluation["steps"]) == (3, 18)
    assert (evaluation["dataset"], evaluation["env"]) == (recipe.dataset, "Hopper-v5")
    assert len(other["returns"]) == 2
    assert other["returns"] != evaluation["returns"][:2]
    # The network without dropout, with tanh of the mean: playing again gives the same.
    step, algorithm, _ = load_trained(run)
    (outcome,) = algorithm.play(step)
    assert outcome.returns == evaluation["returns"]


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_resumes_bit_for_bit(tmp_path, make):
    settings = {"critic": "backbone"} if make is make_cql else {}
    assert_resumes_bit_for_bit(make(tmp_path, backbone=tit(4), **settings), tmp_path)


class Interrupt(Callback):
    """Ctrl-C after some update."""

    def __init__(self, step: int) -> None:
        self.step = step

    def updated(self, step, policy):
        if step == self.step:
            os.kill(os.getpid(), signal.SIGINT)
        return False


def test_a_run_that_was_stopped_resumes_bit_for_bit(tmp_path):
    recipe = make_cql(tmp_path, backbone=tit(4))
    whole = train(recipe, tmp_path / "whole")
    with Run.create(tmp_path / "stopped", recipe) as run:
        with pytest.raises(KeyboardInterrupt):
            train_in(recipe, run, [Interrupt(7)])
        assert load_checkpoint(run.checkpoints)[0] == 7
        torch.manual_seed(123)  # the resuming process may be in any state
        train_in(recipe, run)
    assert_same_run(run, whole)


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


def test_critics_start_as_they_were_built(tmp_path):
    """The loss would draw each entry uniformly between the extremes of its tensor: a wider std."""
    network = enhanced_tit(embed_dim=64, num_blocks=1)
    algorithm = make_algorithm(make_cql(tmp_path, critic="backbone", backbone=network))
    weights = dict(algorithm.model.qvalue_network_params.items(True, True))
    embeddings = [w for key, w in weights.items() if key[-3:] == ("ffn", "0", "weight")]
    assert len(embeddings) == 2
    for first, second in embeddings:
        assert first.std().item() == pytest.approx(0.02, rel=0.05)
        assert second.std().item() == pytest.approx(0.02, rel=0.05)
        assert not torch.equal(first, second)


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


def test_command_line(tmp_path, capsys):
    path = tmp_path / "recipe.json"
    path.write_text(recipe_to_json(make_cql(tmp_path)))
    out = tmp_path / "run"
    main(
        f"train {path} --backbone.num-frames 2 --backbone.frame.embed-dim 16 --critic-hidden 8 8 "
        f"--over-critics sum --out {out}".split()
    )
    assert "over 3 episodes after 18 updates" in capsys.readouterr().out
    recipe = Run.open(out).recipe
    assert isinstance(recipe, CQL)
    assert isinstance(recipe.backbone.frame, Inner)
    assert (recipe.backbone.num_frames, recipe.backbone.frame.embed_dim) == (2, 16)
    assert (recipe.critic_hidden, recipe.over_critics) == ((8, 8), "sum")
    assert json.loads((out / "evaluation.json").read_text())["score"].keys() == {"best", "last"}
    assert (out / "learning_curve.png").is_file()
    main(["evaluate", str(out), "--episodes", "2"])
    assert "over 2 episodes" in capsys.readouterr().out
    main(["table", str(out)])
    assert "| cql/hopper/small | 1 |" in capsys.readouterr().out


def test_a_loss_that_is_not_finite_stops_the_run(tmp_path):
    recipe = make_cql(tmp_path)
    with Run.create(tmp_path / "run", recipe) as run:
        train_in(replace(recipe, total_updates=9), run)
        poisoned = unchecked(recipe, critic_learning_rate=float("inf"))
        with pytest.raises(
            FloatingPointError, match=r"in the update at step \d+.*of step 9 is good"
        ):
            train_in(poisoned, run)
    assert load_checkpoint(run.checkpoints)[0] == 9
