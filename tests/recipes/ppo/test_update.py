"""Whole updates of PPO, repeated by hand; warm-up, CoBERL's loss, and parameters in one tensor."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn

from recipes.coberl import ContrastivePPO
from recipes.core.metrics import read_metrics
from recipes.ppo import PPO, Minibatch, PPOAlgorithm, flatten_parameters
from tests.recipes.ppo.algorithms import named, prepared
from tests.recipes.small import Batches, train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.networks import masked_predictions
from torchrl_tit.objectives import contrastive_prediction_loss
from torchrl_tit.settings.networks import coberl, enhanced_tit, mlp
from torchrl_tit.windows import Windows, find_windows

RECIPE = PPO(
    env="CartPole-v1",
    backbone=enhanced_tit(2, embed_dim=8, features_dim=8),
    total_steps=128,
    steps_per_batch=64,
    num_envs=2,
    minibatch_size=24,  # the last minibatch of an epoch is smaller; sequences have 8 steps
    epochs=2,
    # Large steps, so that ratios are clipped, and a small value loss, so that it hides no other.
    learning_rate=1e-2,
    critic_coeff=0.01,
    entropy_coeff=0.1,
    decay_learning_rate=True,
    decay_clip_epsilon=True,
    decay_entropy_coeff=True,
)


@pytest.fixture
def batches(monkeypatch):
    """For each batch: a copy of the model before the update, and the minibatches of the update.

    These are single steps, with their histories.
    """
    recorded: list[tuple[Any, list[TensorDictBase]]] = []
    original = PPOAlgorithm.minibatches

    def recording(algorithm, *args):
        recorded.append((deepcopy(algorithm.model), []))
        for minibatch in original(algorithm, *args):
            steps, [frames], windows = minibatch
            history = windows.gather(frames)
            recorded[-1][1].append(steps.clone().update({"history": history}).flatten(0, 1))
            yield minibatch

    monkeypatch.setattr(PPOAlgorithm, "minibatches", recording)
    return recorded


def log_prob_and_entropy(model, features, action):
    """From the head's weights alone, by the formulas of the two distributions."""
    if action.dtype == torch.int64:
        log_probs = model.actor[0].module(features).log_softmax(-1)
        return (
            log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1),
            -(log_probs.exp() * log_probs).sum(-1),
        )
    linear, scale = model.actor[0].module
    (log_std,) = scale.parameters()
    error = (action - linear(features)) / log_std.exp()
    log_prob = -(error**2) / 2 - log_std - math.log(2 * math.pi) / 2
    entropy = 0.5 + math.log(2 * math.pi) / 2 + log_std
    return log_prob.sum(-1), entropy.sum(-1).expand(len(features))


def loss_by_hand(model, minibatch, recipe, remaining):
    features = model.backbone.module(minibatch["history"])
    log_prob, entropy = log_prob_and_entropy(model, features, minibatch["action"])
    advantage = minibatch["advantage"].squeeze(-1)
    n = len(advantage)
    mean = advantage.sum() / n
    std = (((advantage - mean) ** 2).sum() / (n - 1)).sqrt()
    advantage = (advantage - mean) / (std + 1e-8)
    clip = recipe.clip_epsilon * remaining
    ratio = (log_prob - minibatch["action_log_prob"]).exp()
    surrogate = torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)
    error = model.critic.module(features) - minibatch["value_target"]
    return (
        -surrogate.mean()
        + recipe.critic_coeff * (error**2).mean()
        - recipe.entropy_coeff * remaining * entropy.mean()
    )


def updates_by_hand(recipe, batches):
    """Weights after all updates, with Adam (arXiv 1412.6980, algorithm 1) written out."""
    model = batches[0][0]
    weights = list(model.parameters())
    first, second = ([torch.zeros_like(w) for w in weights] for _ in range(2))
    t = 0
    for number, (before, minibatches) in enumerate(batches):
        for weight, recorded in zip(weights, before.parameters(), strict=True):
            torch.testing.assert_close(weight, recorded, atol=5e-5, rtol=0)
        remaining = 1 - number / len(batches)
        for minibatch in minibatches:
            loss = loss_by_hand(model, minibatch, recipe, remaining)
            gradients = torch.autograd.grad(loss, weights)
            norm = torch.cat([g.flatten() for g in gradients]).norm()
            t += 1
            with torch.no_grad():
                for w, g, m, v in zip(weights, gradients, first, second, strict=True):
                    g = g * min(1, 0.5 / norm)
                    m.mul_(0.9).add_(0.1 * g)
                    v.mul_(0.999).add_(0.001 * g**2)
                    step = (m / (1 - 0.9**t)) / ((v / (1 - 0.999**t)).sqrt() + 1e-5)
                    w -= recipe.learning_rate * remaining * step
    return model


@pytest.mark.numerics
@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1"])
def test_two_updates_equal_those_by_hand(env, batches, tmp_path):
    recipe = PPO(**(vars(RECIPE) | {"env": env}))
    run = train(recipe, tmp_path / "run")
    _, state = load_checkpoint(run.checkpoints)
    sizes = [[minibatch.numel() for minibatch in minibatches] for _, minibatches in batches]
    assert sizes == [[24, 24, 16] * 2] * 2
    start = deepcopy(batches[0][0].state_dict())
    expected = updates_by_hand(recipe, batches).state_dict()
    assert expected.keys() == state["networks"].keys()
    for name, weight in state["networks"].items():
        torch.testing.assert_close(weight, expected[name], atol=5e-5, rtol=0, msg=name)
    moved = max((expected[name] - start[name]).abs().max() for name in start)
    assert moved > 1e-2  # a tolerance of 5e-5 is a small part of it


def test_metrics_tell_how_far_features_are_spread(tmp_path):
    seen = Batches()
    run = train(RECIPE, tmp_path / "run", seen)
    for row, batch in zip(read_metrics(run.folder / "metrics.csv"), seen.batches, strict=True):
        deviations = batch["features"].reshape(-1, 8).std(0)
        assert row["feature_spread"] == pytest.approx(deviations.mean().item(), rel=1e-5)


SMALL = PPO(env="CartPole-v1", backbone=mlp(hidden_dim=8), num_envs=2, steps_per_batch=64)
COBERL = coberl(4, embed_dim=16, num_heads=2, num_blocks=1, features_dim=8, gate_bias=2)


@pytest.mark.parametrize(
    ("decay", "expected"),
    [(False, [1 / 3, 2 / 3, 1, 1]), (True, [1 / 3, 2 / 3 * 3 / 4, 1 / 2, 1 / 4])],
)
def test_warm_up_rises_linearly_and_decay_follows(decay, expected, tmp_path):
    recipe = replace(SMALL, total_steps=256, warmup_steps=192, decay_learning_rate=decay, epochs=1)
    run = train(recipe, tmp_path / "run")
    rates = [row["learning_rate"] for row in read_metrics(run.folder / "metrics.csv")]
    assert rates == pytest.approx([3e-4 * fraction for fraction in expected])


def test_the_contrastive_loss_is_added_with_its_weight(tmp_path):
    recipe = replace(named("ppo/pong/coberl-tuned"), backbone=COBERL, num_envs=1, compile="off")
    assert isinstance(recipe, ContrastivePPO)
    n = 8
    steps = TensorDict(
        {
            "action": torch.randint(0, 6, (n, 1)),
            "action_log_prob": -torch.rand(n, 1),
            "advantage": torch.randn(n, 1, 1),
            "value_target": torch.randn(n, 1, 1),
        },
        [n, 1],
    )
    frames = torch.randint(0, 256, (n + 3, 84, 84), dtype=torch.uint8)
    windows = Windows(torch.arange(n).view(n, 1, 1) + torch.arange(4), None)
    results = []
    for coeff in (0.0, 0.3):
        torch.manual_seed(0)
        algorithm = prepared(replace(recipe, contrastive_coeff=coeff), tmp_path)
        assert algorithm.terms[-1] == "loss_contrastive"
        torch.manual_seed(1)
        results.append(algorithm.objective(Minibatch(steps.copy(), [frames], windows)))
    (plain, plain_terms), (total, terms) = results
    torch.manual_seed(1)
    mask = torch.rand(n, 4) < 0.15
    network = algorithm.model.backbone.module
    predictions = masked_predictions(network, [windows.gather(frames).squeeze(1)], mask)
    expected = 0.3 * contrastive_prediction_loss(*predictions, mask)
    assert 0 < mask.sum() < mask.numel()
    torch.testing.assert_close(total, plain + expected, rtol=1e-4, atol=1e-5)
    expected_terms = torch.cat([plain_terms[:-1], expected.detach().unsqueeze(0)])
    torch.testing.assert_close(terms, expected_terms, rtol=1e-4, atol=1e-5)
    gradient = torch.autograd.grad(total, network.history_encoder.mask_token)
    assert gradient[0].any()


def test_the_contrastive_loss_reads_each_frame_once_and_no_padding(tmp_path, monkeypatch):
    recipe = replace(named("ppo/pong/coberl-tuned"), backbone=COBERL, num_envs=1, compile="off")
    algorithm = prepared(recipe, tmp_path)
    newest = torch.arange(20).view(2, 10)
    oldest = torch.tensor([0, 0, 0, 0, 0, 0, 6, 6, 6, 6]) + torch.tensor([[0], [10]])
    seen = []

    def look(network, histories, mask):
        seen.append((histories[0], mask))
        return masked_predictions(network, histories, mask)

    monkeypatch.setattr("recipes.coberl.masked_predictions", look)
    monkeypatch.setattr("recipes.coberl._MASKED", 1.0)
    frames = torch.arange(20, dtype=torch.uint8).view(20, 1, 1).expand(20, 84, 84)
    steps = TensorDict(
        {
            "action": torch.randint(0, 6, (2, 10)),
            "action_log_prob": -torch.rand(2, 10),
            "advantage": torch.randn(2, 10, 1),
            "value_target": torch.randn(2, 10, 1),
        },
        [2, 10],
    )
    for padding in ("same", "constant"):
        windows = find_windows(newest, oldest, 4, padding)
        algorithm.loss(Minibatch(steps.copy(), [frames], windows))
        histories, mask = seen.pop()
        read = histories[..., 0, 0][mask].tolist()
        assert read == [0, 1, 2, 3, 6, 7, 10, 11, 12, 13, 16, 17]


def test_parameters_stay_views_when_weights_are_loaded():
    network, saved = nn.Linear(2, 2), nn.Linear(2, 2)
    flat = flatten_parameters(list(network.parameters()))
    network.load_state_dict(saved.state_dict())
    assert torch.equal(flat, torch.cat([p.flatten() for p in saved.parameters()]))
    network(torch.ones(1, 2)).sum().backward()
    assert flat.grad is not None
    assert torch.equal(flat.grad, torch.ones(6))
