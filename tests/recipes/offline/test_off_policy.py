"""What is estimated from data: fitted Q evaluation where the values are known, and the command."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import MultiCategorical

from recipes.cli import main
from recipes.iql import IQL
from recipes.offline import read_data, with_spaces
from recipes.ppo import PPO
from recipes.tools import off_policy
from recipes.tools.off_policy import (
    clone,
    evaluate_on_data,
    fit_q,
    fitted_q,
    recorded_log_probs,
    weighted_returns,
)
from tests.agents.runs import make_run
from tests.recipes.commands import fails
from tests.recipes.offline.test_without_env import log_machine
from tests.recipes.small import BC, SMALL, DiscreteCQL, make, make_algorithm, make_dt, train
from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays, load_episodes
from torchrl_tit.settings.networks import gru

GAMMA = 0.5


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
    [((1, 0), (1 / (1 - GAMMA), 1 / (1 - GAMMA))), ((1, 1), (1 + GAMMA * 2, 2)), ((0, 0), (0, 1))],
)
def test_values_of_discrete_policies(actions, values):
    torch.manual_seed(0)
    table = torch.tensor(actions)

    def choose(observation):
        return table[observation.argmax(-1)]

    policy = TensorDictModule(choose, ["observation"], ["action"])
    critic = TensorDictModule(nn.Linear(2, 2), ["observation"], ["state_action_value"])
    items = two_states()
    value = fit_q(policy, critic, items, gamma=GAMMA, updates=700, learning_rate=0.02)
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
    value = fit_q(policy, critic, items, gamma=GAMMA, updates=700, learning_rate=0.02)
    assert value(torch.tensor([0])).item() == pytest.approx(0.5 / (1 - GAMMA), rel=0.03)


def test_no_value_is_beyond_what_the_rewards_allow():
    """Where a policy does what the data lack, nothing else would hold its values."""
    items, beyond = two_states(), nn.Linear(2, 2)
    critic = TensorDictModule(beyond, ["observation"], ["state_action_value"])
    policy = TensorDictModule(lambda x: x.argmax(-1), ["observation"], ["action"])
    for bias, expected in ((1e3, 2 / (1 - GAMMA)), (-1e3, 0)):
        nn.init.constant_(beyond.bias, bias)
        value = fit_q(policy, critic, items, gamma=GAMMA, updates=0)
        torch.testing.assert_close(value(torch.arange(3)), torch.full([3], expected).double())
    nn.init.constant_(beyond.bias, 1e3)  # targets are cut, so values fall at once
    fit_q(policy, critic, items, gamma=GAMMA, updates=150, learning_rate=10.0)
    assert beyond(torch.eye(2)).abs().max() < 60


def test_an_estimate_of_an_algorithms_policy(tmp_path):
    """Every step pays 2, whatever the action; the interval covers the episodes' starts."""
    data = log_machine(tmp_path / "log.hdf5", rewards=np.full(200, 2.0))
    algorithm = make_algorithm(IQL(dataset=str(data), backbone=SMALL, gamma=0.5))
    episodes = algorithm.load_data()
    found = fitted_q(algorithm, episodes, 300)
    assert found["gamma"] == 0.5
    assert found["value"] == pytest.approx(4, rel=0.05)
    assert found["low"] <= found["value"] <= found["high"]
    assert found["data_value"] == pytest.approx(4 * (1 - 0.5**20))
    assert fitted_q(algorithm, episodes, 2) == fitted_q(algorithm, episodes, 2)


def test_without_a_discount_there_is_no_fitted_value(tmp_path):
    data = log_machine(tmp_path / "log.hdf5")
    algorithm = make_algorithm(IQL(dataset=str(data), backbone=SMALL, gamma=1.0))
    with pytest.raises(ValueError, match="of a run with gamma 1 has no scale"):
        fitted_q(algorithm, algorithm.load_data(), 1)


def test_actions_of_several_choices_have_no_fitted_value(tmp_path):
    spec = MultiCategorical([2, 3])
    algorithm: Any = SimpleNamespace(recipe=BC(dataset="a", backbone=SMALL), action_spec=spec)
    episodes = load_episodes(str(log_machine(tmp_path / "log.hdf5")))
    with pytest.raises(ValueError, match=r"those of a are MultiCategorical.*leave out"):
        fitted_q(algorithm, episodes, 1)


def test_weights_are_those_of_the_formula(tmp_path):
    """A third of the steps take the policy's action; what an episode pays later weighs less."""
    draw = np.random.default_rng(1)
    actions, log_probs = draw.integers(3, size=200), np.log(draw.uniform(0.2, 0.9, 200))
    data = log_machine(tmp_path / "log.hdf5", length=2, actions=actions)
    with h5py.File(data, "a") as file:
        file["action_log_probs"] = log_probs[:, None]
    algorithm = make_algorithm(make(DiscreteCQL, tmp_path, env="", dataset=str(data), gamma=0.5))
    episodes = read_data(algorithm.recipe)
    known = recorded_log_probs(str(data), episodes)
    found = weighted_returns(algorithm, episodes, known, 0)

    items = HistoryStorage(replace(episodes, final_known=torch.ones(100).bool()))
    same = (algorithm.policy(items.get(slice(None)))["action"].numpy() == actions).reshape(100, 2)
    ratios = np.cumprod(same / np.exp(log_probs).reshape(100, 2), 1)
    rewards = episodes.rows["reward"].view(100, 3)[:, :2].double().numpy()
    value = sum(0.5**t * np.average(rewards[:, t], weights=ratios[:, t]) for t in range(2))
    assert found["value"] == pytest.approx(value, rel=1e-6)
    assert found["low"] < value < found["high"]
    last = ratios[:, 1]
    assert found["effective_episodes"] == pytest.approx(last.sum() ** 2 / (last**2).sum())
    assert found["behavior"] == "read from action_log_probs"

    rows = episodes.rows.copy()
    rows["action"] = (rows["action"] + 1) % 3  # no longer what the policy does, where it was
    rows["action"][episodes.step_rows[~same.ravel()]] = actions.max() + 1
    with pytest.raises(ValueError, match="up to its end"):
        weighted_returns(algorithm, replace(episodes, rows=rows), known, 0)


def test_resamples_in_which_no_episode_has_a_weight_do_not_count(tmp_path, monkeypatch):
    """All episodes return the same, and two of twenty take the policy's actions to their end."""
    actions = np.zeros((20, 10), int)
    actions[2:, 5] = 1
    arrays: dict[str, Any] = {"actions": actions.ravel(), "rewards": np.full(200, -1.0)}
    data = log_machine(tmp_path / "log.hdf5", length=10, **arrays)
    algorithm = make_algorithm(make(DiscreteCQL, tmp_path, env="", dataset=str(data), gamma=0.5))
    monkeypatch.setattr(off_policy, "_act", lambda _, states: torch.zeros(len(states)).long())
    episodes = read_data(algorithm.recipe)
    found = weighted_returns(algorithm, episodes, torch.full([200], -0.7).double(), 0)
    for name in ("value", "low", "high", "data_value"):
        assert found[name] == pytest.approx(-2 * (1 - 0.5**10))


def what_is_given_to(ope: str, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Keeps what an estimate is made of."""
    found: list[Any] = []

    def keep(_: Any, *given: Any) -> dict[str, float]:
        found.extend(given)
        return {}

    name = {"fqe": "fitted_q", "wis": "weighted_returns"}[ope]
    monkeypatch.setattr(off_policy, name, keep)
    return found


@pytest.mark.parametrize("ope", ["fqe", "wis"])
def test_an_unfinished_episode_has_no_return(tmp_path, monkeypatch, ope):
    data = log_machine(tmp_path / "log.hdf5", 205, actions=np.arange(205) % 3)
    recipe = with_spaces(BC(dataset=str(data), backbone=SMALL, total_updates=1, name="bc/mine"))
    run, found = train(recipe, tmp_path / "run"), what_is_given_to(ope, monkeypatch)
    evaluate_on_data(run, recipe, str(data), ope=ope)
    assert found[0].lengths.tolist() == [20] * 10


@pytest.mark.parametrize("ope", ["fqe", "wis"])
def test_parts_of_episodes_that_a_gap_cut_are_left_out(tmp_path, monkeypatch, ope):
    draw = np.random.default_rng(0)
    observations = draw.normal(size=(200, 5))
    following = np.roll(observations, -1, 0)
    following[24] += 1  # of ten episodes of 20 steps, the second lost a step
    arrays: dict[str, Any] = {"observations": observations, "next_observations": following}
    data = log_machine(tmp_path / "log.hdf5", actions=np.arange(200) % 3, **arrays)
    log_probs = -draw.random(200)
    with h5py.File(data, "a") as file:
        file["action_log_probs"] = log_probs
    recipe = with_spaces(
        BC(dataset=str(data), backbone=SMALL, total_updates=1, gaps="cut", name="bc/mine")
    )
    run, found = train(recipe, tmp_path / "run"), what_is_given_to(ope, monkeypatch)
    evaluate_on_data(run, recipe, str(data), ope=ope)
    assert found[0].lengths.tolist() == [20] * 9
    if ope == "wis":
        assert found[1].tolist() == np.delete(log_probs, np.s_[20:40]).tolist()


def test_behavior_is_cloned_and_not_learnt_by_heart(tmp_path):
    """It acts by the sign of the first sensor, three times in four."""
    draw = np.random.default_rng(0)
    observations = draw.normal(size=(600, 5))
    side = observations[:, 0] > 0
    actions = (side ^ (draw.random(600) < 0.25)).astype(int)
    data = log_machine(tmp_path / "log.hdf5", 600, observations=observations, actions=actions)
    items = HistoryStorage(load_episodes(data))
    torch.manual_seed(0)
    layers = nn.Sequential(nn.Linear(5, 256), nn.ReLU(), nn.Linear(256, 2))
    behavior = TensorDictModule(layers, ["observation"], ["state_action_value"])
    clone(behavior, items, 1000)
    found = items.get(slice(None))
    likely = layers(found["observation"]).softmax(-1)[:, 1].detach()
    right = (found["observation"][:, 0] > 0).float()
    assert (likely - (0.25 + 0.5 * right)).abs().mean() < 0.12


def test_the_command(tmp_path, monkeypatch, capsys, recwarn):
    monkeypatch.setattr(off_policy, "UPDATES", {"fqe": 5, "wis": 5})
    data = str(log_machine(tmp_path / "log.hdf5"))
    recipe = with_spaces(IQL(dataset=data, backbone=SMALL, total_updates=2, name="iql/mine"))
    run = train(recipe, tmp_path / "run")
    recwarn.clear()
    main(["evaluate", str(run.folder), "--dataset", data, "--ope", "fqe", "--best"])
    assert not [x for x in recwarn if "target network" in str(x.message)]
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("iql/mine: after 2 updates (best weights, chosen on held-out")
    assert lines[1].startswith("discounted return (0.99) by fqe: ")
    evaluation = json.loads((run.folder / "evaluation_best_dataset-log_fqe.json").read_bytes())
    assert evaluation["held_out_episodes"] == 10
    other = tmp_path / "other" / "log.hdf5"
    other.parent.mkdir()
    shutil.copy(data, other)
    for name in (data, str(other), data, str(other)):
        main(["evaluate", str(run.folder), "--dataset", name])
    found = [json.loads(x.read_bytes()) for x in run.folder.glob("evaluation_dataset-log*.json")]
    assert sorted(x["dataset"] for x in found) == sorted([data, str(other)])
    assert "is a folder: name a file" in fails(capsys, "evaluate", run.folder, "--out", tmp_path)
    assert evaluation["low"] <= evaluation["value"] <= evaluation["high"]
    dt = train(make_dt(tmp_path, iterations=1, evaluation_episodes=1), tmp_path / "dt")
    ppo = PPO(env="CartPole-v1", backbone=SMALL, evaluation_episodes=1)
    memory: dict[str, Any] = {"backbone": gru(hidden_dim=8), "slice_length": 4}
    for folder, message in {
        train(
            make(BC, tmp_path, total_updates=1, **memory), tmp_path / "memory"
        ).folder: "gru carries a state: leave out --ope",
        dt.folder: "depends on the return that it is told",
        make_run(tmp_path / "ppo", ppo): "reads no data sets",
    }.items():
        words = ["evaluate", folder, "--dataset", tmp_path / "hopper.hdf5", "--ope", "fqe"]
        assert message in fails(capsys, *words)
    wis = ["--dataset", data, "--ope", "wis"]
    assert "by --ope fqe" in fails(capsys, "evaluate", run.folder, *wis)
    discrete = log_machine(tmp_path / "discrete.hdf5", length=2, actions=np.arange(200) % 2)
    bc = BC(dataset=str(discrete), backbone=SMALL, total_updates=2, name="bc/mine")
    run = train(with_spaces(bc), tmp_path / "bc")
    main(["evaluate", str(run.folder), "--dataset", str(discrete), "--ope", "wis"])
    last = capsys.readouterr().out.splitlines()[-2]
    assert last.startswith("probabilities of the data's actions: cloned from the data; the weights")
    with h5py.File(discrete, "a") as file:
        file["action_log_probs"] = np.ones(200)
    words = ["evaluate", run.folder, "--dataset", discrete, "--ope", "wis"]
    assert "'action_log_probs': must be 200 finite numbers, at most 0" in fails(capsys, *words)
    assert "name them with --dataset" in fails(capsys, "evaluate", run.folder, "--ope", "fqe")
