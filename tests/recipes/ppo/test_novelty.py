"""NovelD's bonus: computed by hand, on observations of all kinds, and finding a rare reward."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import Any

import pytest
import torch

from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.novelty import FirstVisits, NovelPPO, Novelty
from recipes.ppo import PPO, PPOAlgorithm
from tests.numerics import assert_near
from tests.recipes.ppo import tasks
from tests.recipes.ppo.algorithms import perturb
from tests.recipes.small import train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

SMALL: dict[str, Any] = {"embed_dim": 8, "features_dim": 8}
TIT = enhanced_tit(3, **SMALL, ffn_dropout_inner=0.5, patch_size="auto")
RECIPE = NovelPPO(
    env="CartPole-v1",
    env_settings=("max_episode_steps=16",),
    backbone=TIT,
    num_envs=2,
    total_steps=192,
    steps_per_batch=96,
    minibatch_size=32,
    epochs=2,
    normalize_rewards=True,
    novelty_coeff=0.3,
    novelty_alpha=0.7,
    evaluation_episodes=2,
    compile="off",
)


def bonuses_by_hand(novelty: Any, batch: Any, recipe: NovelPPO) -> torch.Tensor:
    """The undivided bonuses of a first batch, step by step, [envs, time]."""
    following = batch["next", "observation"].flatten(0, 1)
    mean, deviation = following.mean(0), following.var(0, unbiased=False).add(1e-8).sqrt()

    def normal(observation: torch.Tensor) -> torch.Tensor:
        return ((observation - mean) / deviation).clamp(-5, 5)

    def how_new(observation: torch.Tensor) -> float:
        (frames,) = novelty.target.frames
        tokens = frames.encoder(normal(observation)).unsqueeze(0)
        target, predicted = novelty.target.history_encoder(tokens), novelty.predictor(tokens)
        return math.dist(target.tolist(), predicted.tolist())

    def cell(observation: torch.Tensor) -> tuple[int, ...]:
        return tuple(math.floor(x / recipe.novelty_cell) for x in normal(observation).tolist())

    bonuses = torch.zeros(batch.shape)
    for env, steps in enumerate(batch):
        seen: set[tuple[int, ...]] = set()
        for number, step in enumerate(steps):
            this, after = step["observation"], step["next", "observation"]
            seen.add(cell(this))
            if cell(after) not in seen:
                risen = how_new(after) - recipe.novelty_alpha * how_new(this)
                bonuses[env, number] = max(risen, 0)
            seen.add(cell(after))
            if step["next", "done"]:
                seen = set()
    return bonuses


@pytest.mark.numerics
@pytest.mark.parametrize("backbone", [TIT, mlp(), lstm(hidden_dim=8, **SMALL)])
def test_the_bonus_is_the_one_by_hand(backbone, float64, monkeypatch, tmp_path):
    """At ends of episodes too: no bonus compares an observation with that of another episode."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)
    recipe = replace(RECIPE, backbone=backbone, wrappers=(f"{tasks.__name__}:Double",))
    algorithm: Any = make_algorithm(recipe)
    novelty = algorithm.model.novelty
    perturb(novelty.predictor)
    algorithm.prepare(0, tmp_path)
    algorithm.model.train()  # without effect on dropout in what measures novelty
    batch = next(iter(algorithm.batches()))
    algorithm.close()
    done, truncated = batch["next", "done"], batch["next", "truncated"]
    assert truncated.any()
    assert (done & ~truncated).any()
    with torch.no_grad():
        rewards = PPOAlgorithm(recipe).collected(batch.clone())["next", "reward"]
        found = algorithm.collected(batch.clone())
        expected = bonuses_by_hand(novelty, batch, recipe)
    assert (expected > 0).any()
    assert (expected == 0).any()
    returns, current = [], torch.zeros(2)
    for now, ended in zip(expected.unbind(1), done.squeeze(-1).unbind(1), strict=True):
        returns.append(now + recipe.gamma * current)
        current = returns[-1].masked_fill(ended, 0)
    expected = 0.3 * expected / torch.stack(returns).std(unbiased=False)
    assert_near(found["bonus"].squeeze(-1).float(), expected.float())  # as is the deviation
    assert_near(found["next", "reward"], rewards + found["bonus"])
    assert set(algorithm.returns(batch).tolist()) <= set(map(float, range(1, 17)))  # the task's


def test_first_visits_go_on_from_batch_to_batch():
    cells, visits = torch.randint(3, (2, 61, 2)), FirstVisits()
    done = torch.rand(2, 60, 1) < 0.1
    resets = torch.randint(3, (2, 60, 2))  # where the next episodes begin
    this = cells[:, :-1].clone()
    this[:, 1:] = torch.where(done[:, :-1], resets[:, 1:], this[:, 1:])
    following = cells[:, 1:]
    parts = zip(this.split(20, 1), following.split(20, 1), done.split(20, 1), strict=True)
    found = torch.cat([visits.add(*part) for part in parts], 1)
    for env in range(2):
        seen: list[list[int]] = []
        for step in range(60):
            seen.append(this[env, step].tolist())
            after = following[env, step].tolist()
            assert found[env, step].item() == (after not in seen)
            seen = [] if done[env, step] else [*seen, after]
    zeros, ended = torch.tensor([[[-0.0]]]), torch.tensor([[[False]]])
    assert not FirstVisits().add(zeros.abs(), zeros, ended).any()  # 0.0 and -0.0 are equal


def test_cells_are_coarse_for_floats_and_exact_for_bytes_and_without_width():
    novelty = Novelty(TIT, {"image": (1, 8, 8), "state": (2,)})
    image = torch.randint(256, (5, 1, 8, 8), dtype=torch.uint8)
    image[3], image[4] = image[2], image[1]
    state = torch.tensor([[0.1, 0.1], [0.4, 0.2], [0.1, 0.1], [0.4, 0.2], [0.4, 0.2]])
    for width, expected in ((0.5, {(2, 3), (1, 4)}), (0.0, {(1, 4)})):
        cells = novelty.cells([image, state], width)
        assert cells.shape == (5, 66)
        pairs = combinations(range(5), 2)
        assert {(i, j) for i, j in pairs if cells[i].equal(cells[j])} == expected


def test_it_trains_on_images_categories_and_arrays_together(tmp_path):
    mixed: dict[str, Any] = {"env": "MultiDiscreteActions-v0", "env_settings": ()}
    recipe = replace(RECIPE, **mixed, normalize_observations=True)
    torch.manual_seed(recipe.seed)
    before = make_algorithm(recipe).model.state_dict()
    run = train(replace(recipe, log_interval=recipe.steps_per_batch), tmp_path / "run")
    first, last = read_metrics(run.folder / "metrics.csv")
    assert 0 < last["loss_novelty"] < first["loss_novelty"]
    assert last["bonus"] > 0
    _, state = load_checkpoint(run.checkpoints)
    assert state["bonus_scale"]["statistics"][0] == recipe.total_steps
    for name, weight in state["networks"].items():
        if name.startswith("novelty."):
            fixed = "target" in name and name.rpartition(".")[2] not in (
                "count",
                "mean",
                "variance",
            )
            assert torch.equal(weight, before[name]) == fixed, name


def test_it_finds_the_reward_that_chance_does_not(tmp_path):
    common: dict[str, Any] = {
        "env": "Corridor-v0",
        "backbone": mlp(hidden_dim=16),
        "num_envs": 8,
        "total_steps": 6144,
        "steps_per_batch": 512,
        "minibatch_size": 128,
        "epochs": 4,
        "learning_rate": 3e-3,
        "log_interval": 512,
        "evaluation_episodes": 3,
        "compile": "off",
    }
    returns = []
    for kind in (PPO, NovelPPO):
        run = train(kind(**common), tmp_path / kind.algorithm)
        returns.append(read_metrics(run.folder / "metrics.csv")[-1]["return_mean"])
    assert returns[0] == 0
    assert returns[1] > 0.9
