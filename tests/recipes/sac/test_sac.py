"""SAC: its gradient steps, its networks, and runs that are stopped and resumed."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from recipes.core.algorithm import load_weights
from recipes.core.metrics import read_metrics
from recipes.sac import SAC, SACAlgorithm
from tests.recipes.small import Batches, train
from tests.recipes.small import make_algorithm as make
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint
from torchrl_tit.settings.networks import mlp

SMALL = SAC(
    name="sac/pendulum/small",
    env="Pendulum-v1",
    backbone=mlp(hidden_dim=8, activation="relu"),
    critic_hidden=(16, 16),
    batch_size=8,
    random_steps=20,
    steps_per_batch=10,
    total_steps=60,
    updates_per_step=0.2,
    log_interval=20,
    checkpoint_interval=30,
    evaluation_episodes=1,
)


def test_parts_of_lost_work_are_replaced_or_ignored(tmp_path: Path) -> None:
    run = train(SMALL, tmp_path / "run", Batches(last=30))
    algorithm = make(SMALL)
    algorithm.prepare(0, run.folder)
    for number in (15, 45):  # of a process that was killed before its checkpoint
        steps = {"action": torch.zeros(number, 1), **observed(number, torch.nan)}
        steps["next"] = {**observed(number, torch.nan), **outcome(number)}
        algorithm.buffer.extend(TensorDict(steps, [number]).unsqueeze(0))
        algorithm.buffer_state.state_dict()
    assert checkpoint_steps(run.folder / "replay") == [15, 30, 60]
    algorithm.close()
    train(SMALL, run.folder)
    state = load_checkpoint(run.checkpoints)[1]["buffer"]
    assert state["parts"] == [30, 60]
    algorithm = make(SMALL)
    algorithm.prepare(60, run.folder)
    algorithm.buffer_state.load_state_dict(state)
    algorithm.close()
    stored = algorithm.buffer.storage.get(slice(None))[:, 0]
    assert len(stored) == 60
    assert stored["observation"].isfinite().all()
    # The transitions of one environment, in order.
    going_on = ~stored["next", "done"][:-1, 0]
    going_on[29] = False  # where the run went on with new episodes
    histories, following = stored["history"][1:], stored["next", "history"][:-1]
    assert torch.equal(histories[going_on], following[going_on])


def test_random_steps_are_uniform_and_learn_nothing(tmp_path: Path) -> None:
    recipe = replace(SMALL, random_steps=200, total_steps=220, steps_per_batch=20)
    run = train(recipe, tmp_path / "run", batches := Batches(last=200))
    _, before = load_checkpoint(run.checkpoints)
    train(recipe, run.folder)
    _, after = load_checkpoint(run.checkpoints)
    actions = torch.cat([batch["action"].flatten() for batch in batches.batches])
    quartiles = actions.quantile(torch.tensor([0.25, 0.5, 0.75]))
    torch.testing.assert_close(quartiles, torch.tensor([-1.0, 0.0, 1.0]), atol=0.35, rtol=0)
    assert before["optimizer"]["state"] == {}
    # round(20 * 0.2) gradient steps after the batch that follows.
    assert {state["step"].item() for state in after["optimizer"]["state"].values()} == {4}
    assert read_metrics(run.folder / "metrics.csv")[-1]["alpha"] < 1


def test_metrics_are_means_over_the_gradient_steps_of_a_batch(tmp_path: Path, monkeypatch) -> None:
    taken: list[float] = []
    learn = SACAlgorithm.learn

    def watch(self, samples, number):
        terms = learn(self, samples, number)
        taken.append(terms["loss_qvalue"].item())
        return terms

    monkeypatch.setattr(SACAlgorithm, "learn", watch)
    recipe = replace(SMALL, random_steps=100, total_steps=120, steps_per_batch=20, log_interval=20)
    run = train(recipe, tmp_path / "run")
    [row] = [row for row in read_metrics(run.folder / "metrics.csv") if row["step"] == 120]
    assert len(set(taken)) == len(taken) == 4
    assert row["loss_qvalue"] == pytest.approx(sum(taken) / len(taken), rel=1e-5)


def observed(size: int, value: float) -> dict[str, Any]:
    """Observations of Pendulum's shape."""
    return {"observation": torch.full((size, 3), value)}


def outcome(size: int) -> dict[str, Any]:
    """Rewards, and flags that are all False."""
    flag = torch.zeros(size, 1, dtype=torch.bool)
    reward = torch.randn(size, 1, dtype=torch.float64)
    return {"reward": reward, "terminated": flag, "done": flag.clone()}


def double(recipe: SAC, folder: Path) -> tuple[SACAlgorithm, TensorDict]:
    """An algorithm in float64, ready for gradient steps, and transitions of Pendulum's shapes."""
    torch.manual_seed(0)
    algorithm = make(recipe)
    algorithm.prepare(0, folder)
    algorithm.model.double()
    frames, size = recipe.backbone.num_frames, 16
    seen = torch.randn(size, frames + 1, 3, dtype=torch.float64)
    here, there = (
        {"history": history, "observation": history[:, -1]}
        for history in (seen[:, :-1], seen[:, 1:])
    )
    actions = torch.rand(size, 1, dtype=torch.float64)
    batch = {**here, "action": actions, "next": {**there, **outcome(size)}}
    return algorithm, TensorDict(batch, [size])


def test_the_loss_of_terminal_transitions(tmp_path: Path) -> None:
    """Critics read the newest observation; targets are the rewards; both errors are squared."""
    algorithm, batch = double(replace(SMALL, backbone=mlp(2, hidden_dim=8)), tmp_path)
    batch["next", "terminated"][:] = True
    batch["next", "done"][:] = True
    critics = algorithm.model.qvalue_network_params["module", "0", "module"]
    x = torch.cat([batch["observation"], batch["action"] / 2], -1)  # their bounds are -2, 2
    expected = torch.zeros((), dtype=torch.float64)
    for critic in critics.unbind(0):
        hidden = x
        for layer in ("0", "2"):
            hidden = nn.functional.linear(hidden, critic[layer, "weight"], critic[layer, "bias"])
            hidden = hidden.relu()
        q = nn.functional.linear(hidden, critic["4", "weight"], critic["4", "bias"])
        expected += (q - batch["next", "reward"]).square().mean()
    terms = algorithm.learn(batch, 0)
    algorithm.close()
    torch.testing.assert_close(terms["loss_qvalue"], expected)
    assert terms["alpha"] == 1


def test_a_gradient_step_moves_weights_and_targets(tmp_path: Path) -> None:
    recipe = replace(SMALL, learning_rate=1e-3, tau=0.1, gamma=0.5)
    algorithm, batch = double(recipe, tmp_path)
    before = {name: value.clone() for name, value in algorithm.model.state_dict().items()}
    algorithm.learn(batch, 0)
    algorithm.close()
    after = algorithm.model.state_dict()
    for name, value in after.items():
        if name.endswith(("middle", "half_range")):  # of the actions
            assert torch.equal(value, before[name])
        elif name.startswith("target_"):
            source = after[name.removeprefix("target_")]
            torch.testing.assert_close(value, 0.9 * before[name] + 0.1 * source)
        elif name.startswith(("actor_", "qvalue_", "log_alpha")):
            # Adam's first step is the learning rate, wherever there is a gradient.
            moved = (value - before[name]).abs()
            assert moved.max() == pytest.approx(1e-3, rel=1e-2)
    assert algorithm.model.value_estimator.gamma == 0.5
    # Minus one for actions in units of their bounds, which are -2 and 2.
    assert algorithm.model.target_entropy == pytest.approx(math.log(2) - 1)


def test_no_weight_of_a_critic_may_be_missing(tmp_path: Path) -> None:
    """TorchRL's losses load their networks' weights without missing any."""
    algorithm, _ = double(SMALL, tmp_path)
    weights = algorithm.model.state_dict()
    name = next(name for name in weights if name.startswith("qvalue_network_params"))
    del weights[name]
    with pytest.raises(ValueError, match=f"Missing key {name}"):
        load_weights(algorithm.model, weights)


@pytest.mark.parametrize(
    ("fields", "differ"),
    [
        ({"hide_velocities": True}, True),
        ({"hide_velocities": True, "critic": "mlp"}, False),
        ({}, False),
    ],
)
def test_critics_read_the_history_where_velocities_are_hidden(
    fields: dict[str, Any], differ: bool
) -> None:
    """Two states with one observation: a pendulum that swings left and one that swings right."""
    loss = make(replace(SMALL, backbone=mlp(2, hidden_dim=8), **fields)).model
    size = 2 if fields else 3
    newest, before = torch.randn(1, size), torch.randn(2, size)
    states = TensorDict(
        {
            "observation": newest.expand(2, size),
            "history": torch.stack([before, newest.expand(2, size)], 1),
            "action": torch.zeros(2, 1),
        },
        [2],
    )
    with loss.qvalue_network_params[0].to_module(loss.qvalue_network):
        left, right = loss.qvalue_network(states)["state_action_value"]
    assert (left != right).item() is differ


def test_a_run_that_ends_at_random_is_warned_of() -> None:
    with pytest.warns(UserWarning, match="total_steps 20 end within the 20 random_steps"):
        make(replace(SMALL, total_steps=20)).check()


def test_a_row_of_random_and_other_steps_has_the_means_of_the_others(tmp_path: Path) -> None:
    fine, coarse = (
        read_metrics(
            train(replace(SMALL, log_interval=n), tmp_path / str(n)).folder / "metrics.csv"
        )
        for n in (10, 60)
    )
    for name in SACAlgorithm.columns:
        values = [row[name] for row in fine]
        assert np.isnan(values[:2]).all()
        assert coarse[0][name] == pytest.approx(np.mean(values[2:]), rel=1e-6)
