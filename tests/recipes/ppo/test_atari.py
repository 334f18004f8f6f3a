"""The Atari recipes: the protocol's settings, clipped rewards and raw returns."""

from dataclasses import replace
from typing import Any

import pytest
import torch

pytest.importorskip("ale_py")

from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.run import Run
from recipes.core.runner import evaluate, train
from recipes.ppo import PPO, PPOAlgorithm
from tests.recipes.ppo.algorithms import named
from torchrl_tit.settings.networks import enhanced_tit, mlp, vanilla_tit

GAMES = {
    "breakout": "ALE/Breakout-v5",
    "mspacman": "ALE/MsPacman-v5",
    "pong": "ALE/Pong-v5",
    "spaceinvaders": "ALE/SpaceInvaders-v5",
}
NETWORKS = [
    *("nature-cnn", "resnet", "catformer", "coberl", "vanilla-tit", "enhanced-tit"),
    *("enhanced-tit-wo-dense", "enhanced-tit-wo-inner", "enhanced-tit-wo-outer"),
]


def test_every_cell_of_the_tables_is_named():
    for game, env in GAMES.items():
        for network in [*NETWORKS, "catformer-tuned", "coberl-tuned"]:
            recipe = named(f"ppo/{game}/{network}")
            other = named(f"ppo/pong/{network}")
            assert replace(recipe, env=other.env, name=other.name) == other
            assert recipe.env == env
            assert recipe == recipe_from_json(recipe_to_json(recipe), "itself")


@pytest.mark.parametrize("name", [f"ppo/pong/{network}" for network in NETWORKS])
def test_protocol_settings(name):
    recipe = named(name)
    expected = {
        "env": "ALE/Pong-v5", "padding": "constant", "num_envs": 8,
        "steps_per_batch": 1024, "minibatch_size": 64 if "tit" in name else 256, "epochs": 4,
        "learning_rate": 2.5e-4, "decay_learning_rate": True, "clip_epsilon": 0.1,
        "decay_clip_epsilon": True, "entropy_coeff": 0.01, "critic_coeff": 0.5, "gamma": 0.99,
        "gae_lambda": 0.95, "clip_rewards": True, "total_steps": 10_000_000,
        "evaluation_episodes": 100, "initialization": "orthogonal",
    }  # fmt: skip
    assert {field: getattr(recipe, field) for field in expected} == expected
    assert recipe.backbone.num_frames == 4
    make_algorithm(recipe).check()  # the network fits the game


def test_zeros_stand_before_the_first_frame():
    env = make_algorithm(named("ppo/pong/nature-cnn")).make_env(1, seed=0)
    history = env.reset()["history"]
    assert not history[:, :-1].any()
    assert history[:, -1].any()
    env.close()


def test_settings_of_tit():
    hyperparameters: dict[str, Any] = {
        "patch_size": 12, "embed_dim": 64, "num_blocks": 2, "num_heads_inner": 4,
        "num_heads_outer": 4, "ffn_expansion_inner": 4, "ffn_expansion_outer": 4,
        "attention_dropout_inner": 0.1, "attention_dropout_outer": 0.1, "ffn_dropout_inner": 0.1,
        "ffn_dropout_outer": 0.1, "features_dim": 512, "activation_head": "gelu",
        "activation_inner": "gelu", "activation_outer": "gelu", "position_encoding": True,
        "share_blocks": False,
    }  # fmt: skip
    enhanced = named("ppo/pong/enhanced-tit").backbone
    assert enhanced == enhanced_tit(4, **hyperparameters)
    assert named("ppo/pong/vanilla-tit").backbone == vanilla_tit(4, **hyperparameters)


@pytest.fixture
def seen_rewards(monkeypatch):
    """The rewards that each update of a run sees."""
    rewards = []

    collected = PPOAlgorithm.collected

    def recording(algorithm, batch):
        batch = collected(algorithm, batch)
        rewards.append(batch["next", "reward"].clone())
        return batch

    monkeypatch.setattr(PPOAlgorithm, "collected", recording)
    return rewards


@pytest.mark.parametrize("clip", [True, False])
def test_training_sees_the_signs_and_returns_are_raw(clip, seen_rewards, tmp_path):
    """Of Pendulum, whose rewards are between -16 and 0."""
    recipe = PPO(
        env="Pendulum-v1",
        backbone=mlp(hidden_dim=8),
        num_envs=2,
        total_steps=400,
        steps_per_batch=400,
        epochs=1,
        evaluation_episodes=2,
        clip_rewards=clip,
    )
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
        returns = evaluate(run)["returns"]
    (rewards,) = seen_rewards
    assert set(rewards.unique().tolist()) <= {-1.0, 0.0} if clip else rewards.min() < -2
    assert read_metrics(run.folder / "metrics.csv")[0]["return_mean"] < -200
    assert max(returns) < -200


def test_a_game_trains_with_signs_and_counts_points(seen_rewards, tmp_path):
    recipe = replace(
        named("ppo/mspacman/nature-cnn"),
        num_envs=2,
        total_steps=512,
        steps_per_batch=512,
        minibatch_size=512,
        epochs=1,
    )
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
    rewards = torch.cat(seen_rewards)
    assert rewards.unique().tolist() == [0, 1]  # a pill is worth 10


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"env": "ALE/Pongg-v5"}, "Unknown task 'ALE/Pongg-v5'; did you mean"),
        ({"env": "CartPole-v1"}, "image"),
        ({"backbone": enhanced_tit(4, patch_size=85)}, "patch"),
        ({"vectorization_mode": "async"}, "leave vectorization_mode at 'sync'"),
        ({"hide_velocities": True}, "velocities"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_runs(fields, message):
    recipe = replace(named("ppo/pong/nature-cnn"), **fields)
    with pytest.raises(ValueError, match=message):
        make_algorithm(recipe).check()
