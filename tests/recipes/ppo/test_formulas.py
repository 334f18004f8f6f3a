"""PPO's settings against the formulas, computed by other means."""

import shutil
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from recipes.core.compilation import should_compile
from recipes.core.registry import get_recipe
from recipes.ppo import PPO, PPOAlgorithm
from tests.recipes.ppo.algorithms import prepared

RECIPE = get_recipe("ppo/cartpole/enhanced-tit")
assert isinstance(RECIPE, PPO)
SMALL = replace(RECIPE, total_steps=64, steps_per_batch=32, num_envs=2, epochs=2, minibatch_size=16)


@pytest.mark.parametrize("setting", ["off", "on"])
def test_the_loss_is_compiled_if_the_recipe_says_so(setting, tmp_path, monkeypatch):
    """What it computes then is in test_rollout.py."""
    monkeypatch.setattr(shutil, "which", lambda name: name)
    monkeypatch.setattr("recipes.ppo.compile_and_time", lambda function, name, owner: name)
    algorithm = prepared(replace(SMALL, compile=setting), tmp_path)
    objective: object = algorithm.objective
    assert (objective == "the loss") is (setting == "on")


@pytest.mark.parametrize(
    ("setting", "steps", "compiler", "expected"),
    [
        ("off", 10**6, True, False),
        ("auto", 100, True, False),
        ("auto", 10**6, False, False),
        ("auto", 10**6, True, True),
        ("on", 1, True, True),
    ],
)
def test_compiling_pays_in_long_runs(setting, steps, compiler, expected, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: name if compiler else None)
    monkeypatch.setattr("recipes.core.compilation._works", lambda: True)
    assert should_compile(setting, steps) is expected


def test_compiling_without_a_compiler_is_refused(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=r"no C\+\+ compiler"):
        should_compile("on", 1)
    with pytest.raises(ValueError, match=r"no C\+\+ compiler"):
        PPOAlgorithm(replace(SMALL, compile="on")).check()


@pytest.mark.numerics
def test_initialization_is_that_of_stable_baselines3():
    model = PPOAlgorithm(SMALL).model
    network: nn.Module = model.backbone.module
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            weight = layer.weight.flatten(1)
            weight = weight if weight.shape[0] <= weight.shape[1] else weight.T
            identity = 2 * torch.eye(len(weight))
            torch.testing.assert_close(weight @ weight.T, identity, atol=1e-4, rtol=0)
            assert not layer.bias.any()
    heads: list[tuple[Any, float]] = [(model.actor[0].module, 0.01), (model.critic.module, 1.0)]
    for layer, gain in heads:
        norms = layer.weight.norm(dim=1)
        torch.testing.assert_close(norms, torch.full_like(norms, gain))
        assert not layer.bias.any()
