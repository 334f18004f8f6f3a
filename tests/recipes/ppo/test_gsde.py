"""State-dependent noise: drawn anew after some steps, with the log-probabilities of a Gaussian."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from recipes.core.algorithm import make_algorithm
from recipes.core.runner import evaluate, load_trained
from recipes.gsde import SmoothPPO, StateDependentNoise
from tests.numerics import assert_near
from tests.recipes.ppo import tasks
from tests.recipes.small import train
from torchrl_tit.evaluation import evaluate as play
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

SMALL: dict[str, Any] = {"embed_dim": 8, "features_dim": 8}
RECIPE = SmoothPPO(
    env="Pendulum-v1",
    env_settings=("max_episode_steps=7",),
    backbone=enhanced_tit(2, **SMALL),
    num_envs=3,
    total_steps=120,
    steps_per_batch=60,
    minibatch_size=30,
    epochs=2,
    noise_steps=5,
    evaluation_episodes=2,
    compile="off",
)


@pytest.mark.numerics
@pytest.mark.parametrize("backbone", [RECIPE.backbone, mlp(), lstm(hidden_dim=8, **SMALL)])
def test_noise_and_log_probabilities_are_those_by_hand(backbone, float64, monkeypatch, tmp_path):
    """In the batch, whose episodes end while the noise keeps its weights, and in the update."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)
    wrappers = (f"{tasks.__name__}:Double",)
    recipe = replace(RECIPE, backbone=backbone, wrappers=wrappers, initial_std=0.25)
    algorithm: Any = make_algorithm(recipe)
    model, drawn, draw = algorithm.model, [], StateDependentNoise._draw
    mean, noise = (part.module for part in model.actor[0])
    scale = 0.25 * 2 * mean.in_features**-0.5  # of torques from -2 to 2
    assert_near(noise.gsde.sigma, torch.full_like(noise.gsde.sigma, scale))
    torch.nn.init.uniform_(noise.gsde.log_sigma, -2, 1)
    torch.nn.init.normal_(mean.weight)

    def recording(module: StateDependentNoise, features: torch.Tensor) -> torch.Tensor:
        drawn.append(draw(module, features))
        return drawn[-1]

    def scale_of(features: torch.Tensor) -> torch.Tensor:
        return (features.square() @ sigma.square().T).sqrt()

    monkeypatch.setattr(StateDependentNoise, "_draw", recording)
    algorithm.prepare(0, tmp_path)
    with torch.no_grad():
        batch = next(iter(algorithm.batches()))
        algorithm.close()
        assert batch["next", "done"][:, 6].all()
        weights = torch.stack(drawn, 1)  # [envs, time, A, F]
        kept = (weights[:, 1:] == weights[:, :-1]).flatten(2).all(-1)
        assert kept.tolist() == [[(step + 1) % 5 != 0 for step in range(19)]] * 3
        assert not torch.equal(weights[0], weights[1])

        features = batch[model.backbone.features_keys[0]]
        sigma = noise.gsde.log_sigma.exp().log1p()  # [A, F]
        error = batch["action"] - features @ mean.weight.T - mean.bias
        assert_near(error, torch.einsum("af,etaf,etf->eta", sigma, weights, features))
        scale = scale_of(features)
        density = (error / scale).square() / 2 + scale.log() + math.log(2 * math.pi) / 2
        assert_near(batch["action_log_prob"], -density.sum(-1))

        rollout = algorithm.rollout(batch)
        algorithm.advantages(batch, rollout)
        model.train()
        for minibatch in algorithm.minibatches(batch, rollout):
            terms = algorithm.loss(minibatch)
            assert abs(terms["kl_approx"]) < 1e-10  # every ratio is 1
            scale = scale_of(minibatch.steps[model.backbone.features_keys[0]])
            entropy = (scale.log() + math.log(2 * math.pi * math.e) / 2).sum(-1)
            assert_near(terms["entropy"], entropy.mean())
        assert len(drawn) == 20  # none in the update


@pytest.mark.parametrize("std", [0.05, 200.0, 2000.0])
def test_every_deviation_can_be_asked_for_and_learns(std):
    noise = StateDependentNoise(64, 1, steps=4, scale=torch.tensor([std]))
    _, scale, _ = noise(torch.zeros(1, 1), torch.ones(1, 64))
    assert_near(scale, torch.tensor([[std]]))
    scale.sum().backward()
    assert noise.gsde.log_sigma.grad.all()


def test_it_trains_and_is_evaluated_without_noise(tmp_path, monkeypatch):
    run = train(RECIPE, tmp_path / "run")
    trained: Any = load_trained(run)[1]
    noise = trained.model.actor[0][1].module
    assert (noise.gsde.log_sigma.diff(dim=-1) != 0).all()  # they were all the same
    monkeypatch.delattr(StateDependentNoise, "_draw")
    assert evaluate(run)["episodes"] == 2


def test_noise_of_one_evaluation_is_not_left_for_the_next():
    algorithm = make_algorithm(RECIPE)
    algorithm.policy.eval()

    def returns():
        return play(algorithm.make_env, algorithm.policy, 4, seed=3, deterministic=False)

    assert torch.equal(returns(), returns())


def test_choices_are_refused():
    with pytest.raises(ValueError, match="noise is for continuous actions, not for Categorical"):
        make_algorithm(replace(RECIPE, env="CartPole-v1"))


@pytest.mark.slow
def test_it_trains_compiled(tmp_path):
    """Code without guards would take one module for another where the graph breaks."""
    assert train(replace(RECIPE, compile="on"), tmp_path / "run").read("metrics.csv")
