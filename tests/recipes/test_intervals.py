"""No number of a run depends on when it is saved or evaluated, and a resumed run loses nothing."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from recipes.core.algorithm import NotFiniteError, make_algorithm
from recipes.core.callback import Callback
from recipes.core.metrics import read_metrics
from recipes.core.recipe import Recipe
from recipes.core.recipe_json import recipe_to_json
from recipes.core.run import Run
from recipes.core.runner import evaluate
from recipes.core.task import make_task, seed_copies
from recipes.dqn import DQN
from recipes.novelty import NovelPPO
from recipes.ppo import PPO
from recipes.sac import SAC
from tests.recipes.commands import fails
from tests.recipes.ppo import tasks as ppo_tasks
from tests.recipes.small import Batches, train
from tests.recipes.states import TIMES, assert_same
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.envs import AtariGames
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

# Active dropout draws from the global generator too.
TIT = enhanced_tit(3, embed_dim=8, features_dim=8, ffn_dropout_inner=0.1)
PPO_RECIPE = PPO(
    env="CartPole-v1",
    backbone=TIT,
    num_envs=2,
    total_steps=160,
    steps_per_batch=32,
    minibatch_size=16,
    epochs=1,
    learning_rate=0.01,
    normalize_rewards=True,
    normalize_observations=True,
    running_advantage_floor=0.5,
    target_kl=1e-3,
    log_interval=64,
    checkpoint_interval=10**6,
    evaluation_episodes=2,
    compile="off",
)
_REPLAY: dict[str, Any] = {
    "num_envs": 2,
    "total_steps": 160,
    "random_steps": 32,
    "steps_per_batch": 32,
    "updates_per_step": 0.125,
    "batch_size": 8,
    "log_interval": 64,
    "checkpoint_interval": 10**6,
    "evaluation_episodes": 1,
}
SAC_RECIPE = SAC(
    env="Pendulum-v1",
    env_settings=("max_episode_steps=40",),
    backbone=mlp(2, hidden_dim=8),
    critic_hidden=(8,),
    **_REPLAY,
)
DQN_RECIPE = DQN(env="CartPole-v1", backbone=TIT, buffer_size=64, slice_length=4, **_REPLAY)
RECIPES: dict[str, Recipe] = {
    "CartPole": PPO_RECIPE,
    "novelty": NovelPPO(**vars(PPO_RECIPE)),
    "recurrent": replace(PPO_RECIPE, backbone=lstm(embed_dim=8, hidden_dim=8, features_dim=8)),
    "TorchRL": replace(
        PPO_RECIPE, env="torchrl.envs:PendulumEnv", env_settings=("max_episode_steps=10",)
    ),
    "collectors": replace(PPO_RECIPE, collectors=2),
    "SAC": SAC_RECIPE,
    "DQN": DQN_RECIPE,
}
KINDS = [
    *("CartPole", "novelty", "recurrent", "SAC", "DQN"),
    pytest.param("collectors", marks=pytest.mark.slow),
]


def train_in(folder: Path, recipe: Recipe, *callbacks: Callback) -> dict[str, Any]:
    """Trains in a run folder, new or not, and returns the newest checkpoint."""
    return load_checkpoint(train(recipe, folder, *callbacks).checkpoints)[1]


def rows_of(folder: Path) -> list[dict[str, str]]:
    """The rows of metrics at multiples of 64, without the clock and evaluations."""
    rows = read_metrics(folder / "metrics.csv")
    left_out = (*TIMES, "evaluation_return")
    return [
        {name: str(value) for name, value in row.items() if name not in left_out}
        for row in rows
        if row["step"] % 64 == 0
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_depends_on_checkpoints_and_evaluations(kind: str, tmp_path: Path) -> None:
    recipe = RECIPES[kind]
    whole = train_in(tmp_path / "whole", recipe)
    rows = rows_of(tmp_path / "whole")
    assert len(rows) == 2
    after_each_batch: dict[str, Any] = {"checkpoint_interval": 32, "evaluation_interval": 32}
    other = train_in(tmp_path / "other", replace(recipe, **after_each_batch))
    assert rows_of(tmp_path / "other") == rows
    for part in whole.keys() - {"record", "best", "buffer"}:
        assert_same(other[part], whole[part])
    for name in ("sums", "count", "returns"):
        assert_same(other["record"][name], whole["record"][name])
    written = read_metrics(tmp_path / "other" / "metrics.csv")
    means = [np.mean(outcome["returns"]) for outcome in other["record"]["outcomes"]]
    assert [row["evaluation_return"] for row in written] == pytest.approx(means)


def starts_of(batch: Any) -> list[tuple[float, ...]]:
    """The first observation of each copy."""
    observation = batch["observation"]
    if not isinstance(observation, torch.Tensor):
        observation = torch.cat([*observation.values()], -1)
    return [tuple(start.tolist()) for start in observation[:, 0]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_begins_new_episodes_and_loses_nothing(kind: str, tmp_path: Path) -> None:
    recipe = RECIPES[kind]
    begun = Batches(96)
    train_in(tmp_path / "first", recipe, begun)
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    stopped = rows_of(tmp_path / "first")
    states, seen = [], []
    for number, name in enumerate(("first", "second")):
        torch.manual_seed(number)  # the resuming process may be in any state
        random.seed(number)
        np.random.seed(number)
        stop = Batches()
        states.append(train_in(tmp_path / name, recipe, stop))
        seen.append(stop.batches)
    assert [len(batches) for batches in seen] == [2, 2]
    # Several processes number their trajectories in the order in which they happen to begin.
    assert_same(*(batches[0].exclude(("collector", "traj_ids")) for batches in seen))
    assert_same(*states)
    assert rows_of(tmp_path / "first") == rows_of(tmp_path / "second")
    assert rows_of(tmp_path / "first")[: len(stopped)] == stopped
    # Episodes and histories are new ones.
    batch = seen[0][0]
    assert (batch["next", "episode_reward"] - batch["next", "reward"])[:, 0].abs().max() == 0
    assert not set(starts_of(batch)) & set(starts_of(begun.batches[0]))  # with other seeds
    if "is_init" in batch.keys():  # noqa: SIM118 (a tensordict)
        assert batch["is_init"][:, 0].all()


@pytest.mark.parametrize("kind", ["CartPole", "TorchRL", "collectors", "SAC", "DQN"])
def test_neighboring_seeds_share_no_environment(kind: str, tmp_path: Path) -> None:
    """No copy of one begins as a copy of another; other tasks are seeded in the same way."""
    starts = []
    for seed in (20, 21, 22):
        algorithm = make_algorithm(replace(RECIPES[kind], seed=seed))
        algorithm.prepare(0, tmp_path)
        starts += starts_of(next(iter(algorithm.batches())))
        algorithm.close()
    assert len(set(starts)) == len(starts) == 6


def test_neighboring_seeds_share_no_game(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ale_py")
    seeds: list[int] = []
    monkeypatch.setattr(AtariGames, "_begin", lambda games, which, given: seeds.extend(given or ()))
    for seed in (20, 21, 22):
        seed_copies(make_task(replace(PPO_RECIPE, env="ALE/Breakout-v5"), 2), seed).close()
    assert len(set(seeds)) == len(seeds) == 6


@pytest.fixture
def paying(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Recipe]:
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", ppo_tasks.__name__)  # in other processes, too
    wrapper = f"{ppo_tasks.__name__}:Paying"
    return lambda recipe, value: replace(recipe, wrappers=(f"{wrapper}(reward={value!r})",))


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        *(("CartPole", "-inf"), ("CartPole", "1e39")),  # in single precision, 1e39 is infinite
        *(("SAC", "nan"), ("DQN", "nan")),
        pytest.param("collectors", "nan", marks=pytest.mark.slow),
    ],
)
def test_a_reward_that_is_not_finite_is_named_in_training(
    kind: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], paying: Any
) -> None:
    recipe = paying(RECIPES[kind], value)
    (tmp_path / "recipe.json").write_text(recipe_to_json(recipe))
    line = fails(capsys, "train", tmp_path / "recipe.json", "--out", tmp_path / "run")
    said = "inf" if value == "1e39" else value
    message = (
        rf"error: the reward of copy \d is {said} in {recipe.env} after step \d+; none was saved"
    )
    assert re.fullmatch(message, line)


def test_a_reward_that_is_not_finite_is_named_in_an_evaluation(tmp_path: Path, paying: Any) -> None:
    train_in(tmp_path / "run", PPO_RECIPE)
    message = r"^the reward of copy 0 is nan in CartPole-v1$"
    with pytest.raises(NotFiniteError, match=message):
        evaluate(Run(tmp_path / "run", PPO_RECIPE), paying(PPO_RECIPE, "nan"))
