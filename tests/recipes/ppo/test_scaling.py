"""Settings that keep PPO's updates of one size, whatever the task's rewards and observations."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from recipes import ppo
from recipes.core.adaptive import ReturnScale, normalize_advantages
from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.core.runner import evaluate
from recipes.ppo import PPOAlgorithm
from tests.recipes.ppo import tasks
from tests.recipes.ppo.algorithms import note_calls, trained
from tests.recipes.small import TINY, train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.frames.normalized import NormalizedFrames
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

RECIPE = replace(
    TINY,
    backbone=enhanced_tit(2, embed_dim=8, features_dim=8),
    total_steps=256,
    num_envs=2,
    epochs=2,
)


def normalized_frames(networks):
    return [m for m in networks.modules() if isinstance(m, NormalizedFrames)]


def test_return_scale_is_the_deviation_of_discounted_returns():
    torch.manual_seed(0)
    rewards, done = torch.randn(3, 40, 1), torch.rand(3, 40, 1) < 0.2
    expected = []
    for env in range(3):
        total = 0.0
        for t in range(40):
            total = rewards[env, t].item() + 0.9 * total
            expected.append((t, total))
            if done[env, t]:
                total = 0.0
    scale = ReturnScale(gamma=0.9)
    for start in (0, 10):  # episodes continue in the next batch
        stop = 10 if start == 0 else 40
        found = scale.update(rewards[:, start:stop], done[:, start:stop])
        seen = torch.tensor([value for t, value in expected if t < stop], dtype=torch.float64)
        assert found.item() == pytest.approx(seen.std(unbiased=False).item(), rel=1e-5)


def test_rewards_are_divided_by_the_deviation_of_returns(tmp_path, monkeypatch):
    """With gamma 0 the value's target is the reward, and CartPole's are all 1."""
    rewards = []
    note_calls(monkeypatch, "collected", lambda batch, *_: rewards.append(batch["next", "reward"]))
    recipe = replace(RECIPE, normalize_rewards=True, reward_scale=100.0)
    run = train(recipe, tmp_path / "run")
    _, state = load_checkpoint(run.checkpoints)
    count, _, squares = state["return_scale"]["statistics"]
    assert count == 256
    deviation = (squares / count).sqrt().item()
    assert rewards[-1].unique().item() == pytest.approx(100 / (deviation + 1e-4), rel=1e-5)
    assert read_metrics(run.folder / "metrics.csv")[-1]["return_mean"] > 5  # not scaled


@pytest.mark.parametrize("clip", [True, False])
def test_training_sees_the_signs_of_rewards_and_returns_are_raw(clip, tmp_path, monkeypatch):
    """Of Pendulum, whose rewards are between -16 and 0."""
    rewards = []
    note_calls(monkeypatch, "collected", lambda batch, *_: rewards.append(batch["next", "reward"]))
    recipe = replace(RECIPE, env="Pendulum-v1", env_settings=("max_episode_steps=100",))
    recipe = replace(recipe, steps_per_batch=200, total_steps=200, epochs=1)
    run = train(replace(recipe, clip_rewards=clip), tmp_path / "run")
    assert set(rewards[0].unique().tolist()) <= {-1.0, 0.0} if clip else rewards[0].min() < -2
    assert read_metrics(run.folder / "metrics.csv")[0]["return_mean"] < -200
    assert max(evaluate(run)["returns"]) < -200


def test_a_resumed_run_begins_with_returns_of_zero():
    """Also on another device: the state holds nothing of the steps."""
    scale, done = ReturnScale(gamma=1.0), torch.zeros(2, 8, 1, dtype=torch.bool)
    scale.update(torch.ones(2, 8, 1), done)
    resumed = ReturnScale(gamma=1.0)
    resumed.load_state_dict(scale.state_dict())
    again = torch.full((2, 8, 1), 3.0)
    found = resumed.update(again, done)
    returns = torch.cat([torch.ones(8).cumsum(0), again[0, :, 0].cumsum(0)])
    assert found.item() == pytest.approx(returns.std(correction=0).item(), rel=1e-5)


def test_advantages_are_divided_by_a_share_of_their_running_deviation(tmp_path, monkeypatch):
    """Advantages that are a thousandth of earlier ones move the policy far less."""
    seen = []

    def recording(advantage, floor):
        seen.append((advantage, floor, normalize_advantages(advantage, floor)))
        return seen[-1][-1]

    sizes = iter([1.0, 1e-3, 1.0])
    monkeypatch.setattr(ppo, "normalize_advantages", recording)
    note_calls(
        monkeypatch, "advantages", lambda _, __, batch, ___: batch["advantage"].mul_(next(sizes))
    )
    recipe = replace(RECIPE, running_advantage_floor=0.5, total_steps=192)
    run = train(recipe, tmp_path / "run")
    batches = [seen[start : start + 4] for start in (0, 4, 8)]  # 2 minibatches, 2 epochs
    variances = [torch.cat([raw for raw, *_ in batch[:2]]).var().item() for batch in batches]
    for count, batch in enumerate(batches, start=1):
        expected = 0.5 * (sum(variances[:count]) / count) ** 0.5
        for raw, floor, normal in batch:
            assert floor == pytest.approx(expected, rel=1e-5)
            scale = max(expected, raw.std().item())
            torch.testing.assert_close(normal, (raw - raw.mean()) / scale, rtol=1e-4, atol=1e-5)
    assert max(normal.abs().max() for *_, normal in batches[1]) < 0.04
    _, state = load_checkpoint(run.checkpoints)
    assert state["advantage_scale"] == {
        "batches": 3,
        "variances": pytest.approx(sum(variances), rel=1e-5),
    }


@pytest.mark.parametrize(("frames", "padding"), [(1, "same"), (8, "same"), (8, "constant")])
def test_each_observation_counts_once(frames, padding, tmp_path, monkeypatch):
    """Neither padding nor the frames before a batch; here many episodes, and short batches."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)
    backbone = enhanced_tit(frames, embed_dim=8, features_dim=8)
    wrappers = (f"{tasks.__name__}:Split",)
    recipe = replace(RECIPE, backbone=backbone, padding=padding, wrappers=wrappers)
    recipe = replace(recipe, normalize_observations=True, steps_per_batch=16, minibatch_size=16)
    recipe = replace(recipe, total_steps=128)
    seen: list[Any] = []
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    for step, batch in enumerate(algorithm.batches()):
        seen.append(batch["observation"].flatten())
        algorithm.update(batch, step * 16)
    algorithm.close()
    encoders = normalized_frames(algorithm.model)
    assert len(encoders) == 2
    for key, encoder in zip(["cart", "pole"], encoders, strict=True):
        expected = torch.cat([batch[key] for batch in seen])
        assert encoder.count == len(expected) == 128
        torch.testing.assert_close(encoder.mean, expected.mean(0), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(encoder.variance, expected.var(0, unbiased=False))


@pytest.mark.parametrize(
    "backbone",
    [
        enhanced_tit(1, embed_dim=8, features_dim=8),
        enhanced_tit(4, embed_dim=8, features_dim=8),
        lstm(embed_dim=8, hidden_dim=8, features_dim=8),
        mlp(hidden_dim=8),
    ],
    ids=["K=1", "K=4", "recurrent", "separate trunks"],
)
@pytest.mark.usefixtures("float64")
def test_acting_and_updating_read_the_same_statistics(backbone, tmp_path, monkeypatch):
    """Before an update's first step all ratios are 1, and all values those that were acted on."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)
    recipe = replace(
        RECIPE,
        env="Pendulum-v1",
        wrappers=(f"{tasks.__name__}:Double",),
        backbone=backbone,
        learning_rate=1e-2,
        normalize_observations=True,
        normalize_rewards=True,
        compile="off",
    )
    before, original = [], PPOAlgorithm.minibatches

    @torch.no_grad()
    def recording(algorithm, batch, rollout):
        before.append(torch.zeros(2, dtype=torch.float64))
        model = algorithm.model.eval()
        for steps, frames, windows in original(algorithm, batch, rollout):
            algorithm._encode(steps, frames, windows)
            log_prob = model.actor.get_dist(steps).log_prob(steps["action"])
            value = model.critic(steps)["state_value"]
            acted = steps["value_target"] - steps["advantage"]
            apart = [log_prob - steps["action_log_prob"], value - acted]
            before[-1] = before[-1].maximum(torch.stack([x.abs().max() for x in apart]))
        model.train()
        yield from original(algorithm, batch, rollout)

    monkeypatch.setattr(PPOAlgorithm, "minibatches", recording)
    algorithm = trained(recipe, tmp_path, batches=3)
    (*_, normalized) = normalized_frames(algorithm.model)
    assert normalized.variance.max() > 2 * normalized.variance.min()
    assert torch.stack(before).shape == (3, 2)
    assert torch.stack(before).max() < 1e-9


def test_the_divergence_is_never_negative(tmp_path, monkeypatch):
    """It is Schulman's estimate, as in Stable-Baselines3, of the whole minibatch."""
    found = []

    def note(terms, algorithm, minibatch):
        steps = minibatch.steps
        with torch.no_grad():
            log_prob = algorithm.model.actor.get_dist(steps).log_prob(steps["action"])
        log_ratio = (log_prob - steps["action_log_prob"]).double()
        found.append((terms["kl_approx"].item(), (log_ratio.expm1() - log_ratio).mean().item()))

    note_calls(monkeypatch, "loss", note)
    trained(replace(RECIPE, learning_rate=0.01, epochs=8), tmp_path, batches=2)
    assert min(expected for _, expected in found[2:16]) > 1e-5
    for mine, expected in found:
        assert mine == pytest.approx(expected, rel=1e-3, abs=1e-6)


@pytest.fixture
def divergences(monkeypatch):
    """The mean divergence of each epoch of an update, which has two minibatches an epoch."""
    found = []
    note_calls(monkeypatch, "loss", lambda terms, *_: found.append(terms["kl_approx"].item()))
    return lambda: [(one + two) / 2 for one, two in zip(found[::2], found[1::2], strict=True)]


def test_an_update_ends_after_the_first_epoch_beyond_the_target(divergences, tmp_path):
    """Nothing is clipped here, so it is the divergence that ends it."""
    recipe = replace(RECIPE, total_steps=64, learning_rate=0.01, epochs=8, clip_epsilon=0.9)
    train(recipe, tmp_path / "free")
    free = divergences()
    target = (free[0] + free[1]) / 2
    assert free[0] < target < free[1] < 3 * target
    run = train(replace(recipe, target_kl=target), tmp_path / "ended")
    assert divergences()[8:] == pytest.approx(free[:2])
    assert read_metrics(run.folder / "metrics.csv")[-1]["epochs"] == 2


@pytest.mark.parametrize("floor", [0.0, 1e-6, 1e6])
def test_advantages_are_divided_by_a_floor_at_least(floor):
    advantage = torch.tensor([1.0, 2.0, 6.0])
    expected = (advantage - 3) / max(7**0.5, floor)
    torch.testing.assert_close(normalize_advantages(advantage, floor), expected)
    assert normalize_advantages(torch.tensor([2.0]), floor).tolist() == [2.0]  # no deviation


def test_the_larger_of_two_floors_applies(tmp_path, monkeypatch):
    floors = []

    def recording(advantage, floor):
        floors.append(floor)
        return normalize_advantages(advantage, floor)

    monkeypatch.setattr(ppo, "normalize_advantages", recording)
    recipe = replace(RECIPE, total_steps=64, running_advantage_floor=0.5)
    for constant in (1e-6, 1e6):
        train(replace(recipe, advantage_floor=constant), tmp_path / f"{constant}")
    assert min(floors[:4]) > 1e-3
    assert floors[4:] == [1e6] * 4


def test_the_discounted_return_begins_anew_at_time_limits(tmp_path):
    recipe = replace(RECIPE, normalize_rewards=True, env_settings=("max_episode_steps=5",))
    algorithm = PPOAlgorithm(recipe)
    algorithm.prepare(0, tmp_path)
    batch = next(iter(algorithm.batches()))
    algorithm.close()
    assert not batch["next", "terminated"].any()
    returns = [(1 - 0.99**steps) / 0.01 for steps in range(1, 6)] * 12
    returns += [(1 - 0.99**steps) / 0.01 for steps in (1, 2)] * 2  # 32 steps of both environments
    expected = 1 / torch.tensor(returns).std(correction=0).item()
    reward = algorithm.collected(batch)["next", "reward"]
    assert reward.unique().item() == pytest.approx(expected, rel=1e-3)


def test_collectors_of_other_processes_get_the_statistics(tmp_path, monkeypatch):
    differences = []
    original = PPOAlgorithm.update

    def recording(algorithm, batch, step):
        with torch.no_grad():
            features = algorithm.model.backbone.module(batch["observation"].unsqueeze(2))
        differences.append((features - batch["features"]).abs().max().item())
        return original(algorithm, batch, step)

    monkeypatch.setattr(PPOAlgorithm, "update", recording)
    backbone = enhanced_tit(1, embed_dim=8, features_dim=8)
    recipe = replace(
        RECIPE, backbone=backbone, collectors=2, normalize_observations=True, learning_rate=0.0
    )
    train(recipe, tmp_path / "run")
    assert len(differences) == 4
    assert max(differences) < 1e-4
