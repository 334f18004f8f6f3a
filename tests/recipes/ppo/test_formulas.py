"""PPO's settings against the formulas, computed by other means."""

import shutil
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import nn

from recipes.core.compilation import should_compile
from recipes.core.registry import get_recipe
from recipes.ppo import PPO, ActorCritic, PPOAlgorithm
from tests.recipes.ppo.algorithms import prepared
from tests.recipes.small import train
from torchrl_tit.settings.networks import mlp

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


def test_numbers_that_a_subclass_changes_change_its_compiled_loss(tmp_path, monkeypatch):
    class Scheduled(PPOAlgorithm):
        weight = 1.0

        def loss(self, minibatch):
            terms = super().loss(minibatch)
            return terms.set("clip_fraction", torch.full((), self.weight))

    monkeypatch.setattr(shutil, "which", lambda name: name)
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    algorithm = Scheduled(replace(SMALL, compile="on", backbone=mlp(1)))
    algorithm.prepare(0, tmp_path)
    with torch.no_grad():
        batch = next(iter(algorithm.batches()))
        algorithm.close()
        rollout = algorithm.rollout(batch)
        algorithm.advantages(batch, rollout)
    minibatch = next(algorithm.minibatches(batch, rollout))
    found = []
    for weight in (1.0, 2.0):
        algorithm.weight = weight
        _, terms = algorithm.objective(minibatch._replace(steps=minibatch.steps.copy()))
        found.append(terms[algorithm.terms.index("clip_fraction")].item())
    assert found == [1, 2]


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


def test_whole_rollouts_cover_the_steps():
    assert RECIPE.final_step == 100_352  # 49 batches of 2048 cover 100k


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


class Recorder:
    """Counts the passes through a network and remembers in which mode they came."""

    def __init__(self, monkeypatch):
        self.modes = []
        original = ActorCritic.__init__

        def init(model, *args):
            original(model, *args)
            model.backbone.module.head.register_forward_hook(self)

        monkeypatch.setattr(ActorCritic, "__init__", init)

    def __call__(self, network, inputs, output):
        kind = "update" if torch.is_grad_enabled() else "act"
        self.modes.append((kind, network.training, len(inputs[0])))


def test_backbone_runs_once_a_step_and_once_a_minibatch(monkeypatch, tmp_path):
    recorder = Recorder(monkeypatch)
    train(SMALL, tmp_path / "run")
    updates = [mode for mode in recorder.modes if mode[0] == "update"]
    acts = [mode for mode in recorder.modes if mode[0] == "act"]
    batches, minibatches_each, epochs = 2, 2, 2
    assert len(updates) == batches * minibatches_each * epochs
    # 16 steps of 2 environments in each batch, and the true next observations of its ends.
    assert len(acts) == batches * (16 + 1)
    assert all(training for _, training, _ in updates)
    assert not any(training for _, training, _ in acts)
