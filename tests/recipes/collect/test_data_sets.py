"""`data collect`: what the sets hold, and what they record of their origin."""

import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from recipes.core.algorithm import make_algorithm
from recipes.core.recipe_json import recipe_to_json
from recipes.core.run import Run
from recipes.core.runner import train
from recipes.ppo import PPO
from recipes.tools.collect import Collection
from recipes.tools.collect.collect import collect
from recipes.tools.collect.settings import KINDS
from tests.recipes.collect.collected import (
    CARTPOLE_RECIPE,
    FIELDS,
    PENDULUM,
    PENDULUM_RECIPE,
    attributes,
    check_episodes,
    read,
)
from tests.recipes.small import Batches
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.datasets import HistoryStorage, load_episodes, make_replay_buffer
from torchrl_tit.settings.networks import mlp, nature_cnn


@pytest.mark.parametrize("kind", KINDS)
def test_every_row_is_a_step_of_the_task(cartpole: Path, pendulum: Path, kind: str) -> None:
    data = read(cartpole / f"{kind}.hdf5")
    env: Any = gymnasium.make("CartPole-v1").unwrapped
    env.reset(seed=0)
    rows = zip(data["observations"], data["actions"], data["next_observations"], strict=True)
    for observation, action, following in rows:
        env.state = observation.astype(np.float64)
        env.steps_beyond_terminated = None
        np.testing.assert_allclose(env.step(int(action))[0], following, atol=1e-5)
    x, angle = data["next_observations"][:, 0], data["next_observations"][:, 2]
    fallen = (np.abs(x) > 2.4) | (np.abs(angle) > 12 * np.pi / 180)
    np.testing.assert_array_equal(data["terminals"], fallen)
    np.testing.assert_array_equal(data["rewards"], np.ones(len(x)))
    dtypes = [data[name].dtype.str for name in FIELDS]
    assert dtypes == ["<f4", "<i8", "<f4", "|b1", "|b1", "<f4"]
    check_episodes(data)

    data = read(pendulum / f"{kind}.hdf5")
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    for row in range(len(data["rewards"])):
        cosine, sine, speed = data["observations"][row].astype(np.float64)
        env.state = np.array([np.arctan2(sine, cosine), speed])
        following, reward, *_ = env.step(data["actions"][row])
        np.testing.assert_allclose(following, data["next_observations"][row], atol=1e-4)
        np.testing.assert_allclose(reward, data["rewards"][row], atol=1e-3)
    assert data["actions"].dtype == np.float32
    assert data["actions"].shape[1:] == (1,)
    assert np.abs(data["actions"]).max() <= 2
    assert not data["terminals"].any()
    check_episodes(data)


def test_rolled_out_sets_are_whole_episodes(cartpole: Path, pendulum: Path) -> None:
    for kind in KINDS:
        data = read(cartpole / f"{kind}.hdf5")
        lengths = np.diff(np.flatnonzero(data["terminals"] | data["timeouts"]), prepend=-1)
        if kind != "mixed":
            assert lengths[:-1].sum() < 300 <= lengths.sum()
            # CartPole has a time limit of 500; the longest that was asked for is 300.
            assert (lengths[data["timeouts"][np.cumsum(lengths) - 1]] == 300).all()
        data = read(pendulum / f"{kind}.hdf5")
        if kind != "mixed":
            assert len(data["rewards"]) == 400  # two episodes
            assert np.flatnonzero(data["timeouts"]).tolist() == [199, 399]


def policy_of(folder: Path, kind: str, recipe: Any) -> Any:
    """The agent that played a set."""
    step = attributes(folder / f"{kind}.hdf5")["agent_steps"]
    _, weights = load_checkpoint(folder / "training" / "agents", step)
    policy = make_algorithm(recipe).policy
    policy.load_state_dict(weights)
    return policy


@pytest.mark.parametrize("kind", ["medium", "expert"])
def test_actions_are_those_of_the_agent_at_its_mark(cartpole: Path, kind: str) -> None:
    policy = policy_of(cartpole, kind, CARTPOLE_RECIPE)
    episodes = load_episodes(cartpole / f"{kind}.hdf5")
    steps = HistoryStorage(episodes, num_frames=2).get(slice(None))
    with torch.no_grad():
        logits = policy(TensorDict({"history": steps["history"]}, len(steps)))["logits"]
    assert torch.equal(logits.argmax(-1), steps["action"])


def test_random_actions_are_uniform(cartpole: Path, pendulum: Path) -> None:
    discrete = read(cartpole / "random.hdf5")["actions"]
    assert abs(discrete.mean() - 0.5) < 0.1
    continuous = read(pendulum / "random.hdf5")["actions"]
    low, middle, high = np.quantile(continuous, [0.25, 0.5, 0.75])
    np.testing.assert_allclose([low, middle, high], [-1, 0, 1], atol=0.25)
    assert np.unique(continuous).size == continuous.size


def test_sampled_actions_differ_from_the_most_likely(pendulum: Path) -> None:
    policy = policy_of(pendulum, "medium", PENDULUM_RECIPE)
    data = read(pendulum / "medium.hdf5")
    histories = torch.from_numpy(data["observations"]).unsqueeze(1)
    td = TensorDict({"history": histories}, len(histories))
    with torch.no_grad():
        distribution = policy.get_dist(td)
    actions = torch.from_numpy(data["actions"])
    assert not torch.allclose(actions, distribution.deterministic_sample, atol=0.1)
    # The shares of the distribution below each action, which are uniform if they are its samples.
    shares = torch.distributions.Normal(td["loc"], td["scale"]).cdf((actions / 2).atanh())
    torch.testing.assert_close(
        shares.flatten().quantile(torch.tensor([0.25, 0.5, 0.75])),
        torch.tensor([0.25, 0.5, 0.75]),
        atol=0.1,
        rtol=0,
    )


@pytest.mark.parametrize("which", ["cartpole", "pendulum"])
def test_mixed_is_everything_that_training_saw(
    which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The batches of the same recipe, trained without collecting data."""
    folder: Path = request.getfixturevalue(which)
    recipe = CARTPOLE_RECIPE if which == "cartpole" else PENDULUM_RECIPE
    mixed, noted = read(folder / "mixed.hdf5"), attributes(folder / "mixed.hdf5")
    recorder = Batches(noted["agent_steps"])
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run, [recorder])

    seen: Any = torch.cat(recorder.batches, 1).reshape(-1)  # one environment after the other
    assert len(seen) == len(mixed["rewards"]) == noted["agent_steps"]
    np.testing.assert_array_equal(mixed["observations"], seen["observation"])
    np.testing.assert_array_equal(mixed["actions"], seen["action"])
    np.testing.assert_array_equal(mixed["rewards"], seen["next", "reward"].squeeze(-1))
    np.testing.assert_array_equal(mixed["terminals"], seen["next", "terminated"].squeeze(-1))
    np.testing.assert_array_equal(mixed["next_observations"], seen["next", "observation"])


def test_the_mark_is_the_first_evaluation_that_reaches_it(cartpole: Path) -> None:
    scores = json.loads((cartpole / "training" / "evaluations.json").read_text())
    assert [score["step"] for score in scores] == [256 * (i + 1) for i in range(len(scores))]
    for kind, mark in (("medium", 100), ("expert", 130)):
        first = next(score for score in scores if score["mean"] >= mark)
        noted = attributes(cartpole / f"{kind}.hdf5")
        assert [noted["agent_steps"], noted["agent_return"]] == [first["step"], first["mean"]]
        assert noted[f"{kind}_return"] == mark
    assert scores[-1]["mean"] >= 130  # where the training ended


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("task", ["cartpole", "pendulum"])
def test_both_formats_hold_the_same_and_where_it_came_from(
    task: str, kind: str, request: pytest.FixtureRequest
) -> None:
    folder: Path = request.getfixturevalue(task)
    settings: Collection = request.getfixturevalue(f"{task}_settings")
    data, again = (load_episodes(folder / f"{kind}{x}", dtype=None) for x in (".hdf5", "-v0"))
    assert (again.rows == data.rows).all()
    noted = data.attributes
    assert noted == again.attributes
    kept = {"env_id": settings.env, "kind": kind, "seed": 0, "command": "the command"}
    algorithm = {"cartpole": "PPO", "pendulum": "SAC"}[task]
    if kind == "random":
        kept["algorithm"] = "uniform actions"
        assert {"agent_steps", "recipe"}.isdisjoint(noted)
    else:
        kept |= {"algorithm": algorithm, "agent": settings.agent}
        recipe = CARTPOLE_RECIPE if task == "cartpole" else PENDULUM_RECIPE
        assert json.loads(noted["recipe"])["total_steps"] == recipe.total_steps
    assert noted.items() >= kept.items()
    assert json.loads(noted["settings"])["total_steps"] == settings.total_steps
    assert json.loads(noted["versions"])["torch"] == version("torch")
    if (task, kind) == ("pendulum", "expert"):  # without a mark, the end of the training
        assert noted["agent_steps"] == 400
        assert "expert_return" not in noted
    dataset = minari.MinariDataset(folder / f"{kind}-v0" / "data")
    assert dataset.env_spec.id == settings.env
    assert dataset.action_space == gymnasium.make(settings.env).action_space
    assert dataset.storage.metadata["algorithm_name"] == noted["algorithm"]


def test_images_are_stored_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Instead of a whole game, which takes half a minute.
    monkeypatch.setattr("recipes.tools.collect.agents.evaluate", lambda *_, **__: torch.zeros(1))
    recipe = PPO(
        env="ALE/Pong-v5",
        backbone=nature_cnn(num_frames=4, features_dim=8),
        padding="constant",
        num_envs=2,
        total_steps=10_000,
        steps_per_batch=32,
        epochs=1,
        clip_rewards=True,
        compile="off",
    )
    (tmp_path / "pong.json").write_text(recipe_to_json(recipe))
    settings = Collection(
        env="ALE/Pong-v5",
        agent=str(tmp_path / "pong.json"),
        sets=("random", "mixed"),
        transitions=100,
        total_steps=128,
        evaluation_episodes=1,
        checkpoint_interval=64,
        num_envs=2,
    )
    collect(settings, tmp_path / "pong")

    for kind, count in (("random", 100), ("mixed", 128)):
        data = read(tmp_path / "pong" / f"{kind}.hdf5")
        assert data["observations"].shape == (count, 84, 84)
        assert data["observations"].dtype == data["next_observations"].dtype == np.uint8
        assert data["actions"].dtype == np.int64
        assert set(np.unique(data["actions"])) <= set(range(6))
        assert len(np.unique(data["observations"].reshape(count, -1), axis=0)) > count / 2
        check_episodes(data)
        dataset = minari.MinariDataset(tmp_path / "pong" / f"{kind}-v0" / "data")
        assert dataset.action_space.n == 6
    # Two games side by side, which checkpoints do not interrupt.
    assert np.flatnonzero(data["timeouts"]).tolist() == [63, 127]
    buffer = make_replay_buffer(
        HistoryStorage(load_episodes(tmp_path / "pong" / "mixed.hdf5"), 4, padding="constant"), 8
    )
    assert buffer.sample()["next", "history"].shape == (8, 4, 84, 84)


def test_rewards_are_the_tasks_own(tmp_path: Path) -> None:
    """Though the recipe clips and scales them."""
    recipe = replace(
        CARTPOLE_RECIPE,
        env="Pendulum-v1",
        backbone=mlp(hidden_dim=32),
        steps_per_batch=800,
        clip_rewards=True,
        reward_scale=0.1,
    )
    (tmp_path / "small.json").write_text(recipe_to_json(recipe))
    settings = replace(
        PENDULUM, agent=str(tmp_path / "small.json"), sets=("mixed",), total_steps=800
    )
    collect(settings, tmp_path / "c")
    data = read(tmp_path / "c" / "mixed.hdf5")
    assert data["rewards"].min() < -2
    assert not data["terminals"].any()
    assert np.flatnonzero(data["timeouts"]).tolist() == [199, 399, 599, 799]
    assert np.abs(data["actions"]).max() == 2  # a Gaussian's, clipped as the task does
