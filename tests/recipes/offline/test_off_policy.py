"""What is estimated from data: fitted Q evaluation where the values are known, and the command."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from recipes.cli import main
from recipes.iql import IQL
from recipes.offline import with_spaces
from recipes.ppo import PPO
from recipes.tools import off_policy
from recipes.tools.off_policy import fit_q, fitted_q
from tests.agents.runs import make_run
from tests.recipes.commands import fails
from tests.recipes.offline.test_without_env import log_machine
from tests.recipes.small import BC, SMALL, make, make_algorithm, make_dt, train
from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays
from torchrl_tit.settings.networks import gru

GAMMA = 0.8


def two_states():
    """The action is the next state; changing pays 1, and staying in state 1 ends it and pays 2."""
    draw = np.random.default_rng(0)
    rows, state = [], 0
    for step in range(600):
        action = int(draw.integers(2))
        ends = state == action == 1
        reward = 2.0 if ends else float(action != state)
        rows.append((np.eye(2)[state], action, reward, ends, step % 20 == 19, np.eye(2)[action]))
        state = 0 if ends or step % 20 == 19 else action
    return HistoryStorage(episodes_from_arrays(*map(np.array, zip(*rows, strict=True))))


@pytest.mark.parametrize(
    ("actions", "values"),
    [
        ((1, 0), (1 / (1 - GAMMA), 1 / (1 - GAMMA))),
        ((1, 1), (1 + GAMMA * 2, 2)),
        ((0, 0), (0, 1)),
    ],
)
def test_values_of_discrete_policies(actions, values):
    torch.manual_seed(0)
    table = torch.tensor(actions)

    def choose(observation):
        return table[observation.argmax(-1)]

    policy = TensorDictModule(choose, ["observation"], ["action"])
    critic = TensorDictModule(nn.Linear(2, 2), ["observation"], ["state_action_value"])
    items = two_states()
    value = fit_q(policy, critic, items, gamma=GAMMA, updates=2500, learning_rate=0.02)
    everything = torch.arange(len(items))
    found, state = value(everything), items.get(everything)["observation"].argmax(-1)
    for number, expected in enumerate(values):
        torch.testing.assert_close(
            found[state == number].mean().item(), float(expected), atol=0.06, rtol=0
        )


def test_value_of_a_continuous_policy():
    """The reward is the action, so always acting 0.5 is worth 0.5 / (1 - gamma)."""
    torch.manual_seed(0)
    actions = np.random.default_rng(0).uniform(-1, 1, (200, 1))
    ends = np.arange(200) % 10 == 9
    states = np.ones((200, 1))
    items = HistoryStorage(
        episodes_from_arrays(states, actions, actions[:, 0], ends & False, ends, states)
    )

    class Critic(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = nn.Linear(2, 1)

        def forward(self, observation, action):
            return self.layer(torch.cat([observation, action], -1))

    policy = TensorDictModule(lambda x: 0.5 * torch.ones_like(x), ["observation"], ["action"])
    critic = TensorDictModule(Critic(), ["observation", "action"], ["state_action_value"])
    value = fit_q(policy, critic, items, gamma=GAMMA, updates=2500, learning_rate=0.02)
    assert value(torch.tensor([0])).item() == pytest.approx(0.5 / (1 - GAMMA), rel=0.03)


def test_an_estimate_of_an_algorithms_policy(tmp_path):
    """Every step pays 2, whatever the action; the interval covers the episodes' starts."""
    data = log_machine(tmp_path / "log.hdf5", rewards=np.full(200, 2.0))
    algorithm = make_algorithm(IQL(dataset=str(data), backbone=SMALL, gamma=0.5))
    episodes = algorithm.load_data()
    found = fitted_q(algorithm, episodes, 600)
    assert found["gamma"] == 0.5
    assert found["value"] == pytest.approx(4, rel=0.05)
    assert found["low"] <= found["value"] <= found["high"]
    assert found["data_value"] == pytest.approx(4 * (1 - 0.5**20))
    assert fitted_q(algorithm, episodes, 600) == found


def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(off_policy, "UPDATES", 5)
    data = str(log_machine(tmp_path / "log.hdf5"))
    recipe = with_spaces(IQL(dataset=data, backbone=SMALL, total_updates=2, name="iql/mine"))
    run = train(recipe, tmp_path / "run")
    main(["evaluate", str(run.folder), "--dataset", data, "--ope", "fqe", "--best"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("iql/mine: after 2 updates (best weights, chosen on held-out")
    assert lines[1].startswith("discounted return (0.99) by fqe: ")
    evaluation = json.loads((run.folder / "evaluation_best_dataset-log.json").read_bytes())
    assert evaluation["held_out_episodes"] == 10
    assert evaluation["low"] <= evaluation["value"] <= evaluation["high"]
    dt = train(make_dt(tmp_path), tmp_path / "dt")
    memory: dict[str, Any] = {"backbone": gru(hidden_dim=8), "slice_length": 4}
    for folder, message in {
        train(
            make(BC, tmp_path, total_updates=1, **memory), tmp_path / "memory"
        ).folder: "gru carries a state: leave out --ope",
        dt.folder: "depends on the return that it is told",
        make_run(tmp_path / "ppo", PPO(env="CartPole-v1", backbone=SMALL)): "reads no data sets",
    }.items():
        words = ["evaluate", folder, "--dataset", tmp_path / "hopper.hdf5", "--ope", "fqe"]
        assert message in fails(capsys, *words)
    assert "name them with --dataset" in fails(capsys, "evaluate", run.folder, "--ope", "fqe")
