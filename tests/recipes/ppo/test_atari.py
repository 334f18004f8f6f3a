"""The Atari recipes: the protocol's settings, clipped rewards and raw returns."""

import pytest

pytest.importorskip("ale_py")

from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.core.runner import evaluate
from recipes.ppo import PPO, PPOAlgorithm
from tests.recipes.ppo.algorithms import named
from tests.recipes.small import train
from torchrl_tit.settings.networks import mlp


def test_zeros_stand_before_the_first_frame():
    env = make_algorithm(named("ppo/pong/nature-cnn")).make_env(1, seed=0)
    history = env.reset()["history"]
    assert not history[:, :-1].any()
    assert history[:, -1].any()
    env.close()


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
    run = train(recipe, tmp_path / "run")
    returns = evaluate(run)["returns"]
    (rewards,) = seen_rewards
    assert set(rewards.unique().tolist()) <= {-1.0, 0.0} if clip else rewards.min() < -2
    assert read_metrics(run.folder / "metrics.csv")[0]["return_mean"] < -200
    assert max(returns) < -200
