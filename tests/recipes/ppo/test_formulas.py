"""PPO's settings against the formulas, computed by other means."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from recipes.compilation import should_compile
from recipes.ppo import PPO, ActorCritic, Minibatch, PPOAlgorithm
from recipes.registry import get_recipe
from recipes.run import Run
from recipes.runner import train
from tests.numerics import assert_near
from tests.recipes.ppo import by_hand
from tests.recipes.ppo.algorithms import prepared
from torchrl_tit.rollout import Rollout
from torchrl_tit.windows import Windows

RECIPE = get_recipe("ppo/cartpole/enhanced-tit")
assert isinstance(RECIPE, PPO)
SMALL = replace(RECIPE, total_steps=64, steps_per_batch=32, num_envs=2, epochs=2, minibatch_size=16)


def fake_batch(model, envs=2, time=7):
    """Two streams with a termination and a time limit inside, and random observations."""
    observation = torch.randn(envs, time + 1, 4)
    terminated = torch.zeros(envs, time, 1, dtype=torch.bool)
    truncated = terminated.clone()
    terminated[0, 2] = truncated[1, 4] = True
    following = observation[:, 1:].clone()
    # Where an episode ends, the next observation is not the one that the next step starts from.
    following[0, 2] = torch.randn(4)
    following[1, 4] = torch.randn(4)
    return TensorDict(
        {
            "observation": observation[:, :-1],
            "state_value": value_of(model, observation[:, :-1]),
            "next": {
                "observation": following,
                "reward": torch.randn(envs, time, 1),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        [envs, time],
    )


@torch.no_grad()
def value_of(model, observation):
    history = TensorDict({"history": observation.unsqueeze(2)}, observation.shape[:2])
    return model.critic(model.backbone(history))["state_value"]


@pytest.mark.numerics
@pytest.mark.parametrize("bootstrap", [True, False])
def test_advantages_follow_the_recursion(bootstrap):
    algorithm = PPOAlgorithm(replace(SMALL, bootstrap_time_limit=bootstrap))
    algorithm.gae = GAE(gamma=0.9, lmbda=0.8, value_network=None)
    batch = fake_batch(algorithm.model)
    next_value = value_of(algorithm.model, batch["next", "observation"])
    with torch.no_grad():
        algorithm.advantages(batch, Rollout(batch, 1, "same"))
    value, reward, done = batch["state_value"], batch["next", "reward"], batch["next", "done"]
    stops = done & ~batch["next", "truncated"] if bootstrap else done
    expected = by_hand.advantages(reward, value, next_value, done, stops, 0.9, 0.8)
    torch.testing.assert_close(batch["advantage"], expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(batch["value_target"], expected + value, atol=1e-5, rtol=1e-5)


def sb3_style_loss(model, observation, minibatch, recipe):
    """The loss as Stable-Baselines3 writes it, from the layers' weights alone."""
    features = model.backbone.module(observation.unsqueeze(1))
    logits = model.actor[0].module(features)
    value = model.critic.module(features).squeeze(-1)
    log_probs = logits - logits.logsumexp(-1, keepdim=True)
    log_prob = log_probs.gather(-1, minibatch["action"].unsqueeze(-1)).squeeze(-1)
    advantage = minibatch["advantage"].squeeze(-1)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    ratio = (log_prob - minibatch["action_log_prob"]).exp()
    clipped = ratio.clamp(1 - recipe.clip_epsilon, 1 + recipe.clip_epsilon)
    policy = -torch.min(advantage * ratio, advantage * clipped).mean()
    critic = ((minibatch["value_target"].squeeze(-1) - value) ** 2).mean()
    entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
    return policy + recipe.critic_coeff * critic - recipe.entropy_coeff * entropy


@pytest.mark.numerics
def test_loss_and_gradient_are_those_of_the_formulas(tmp_path):
    recipe = replace(SMALL, entropy_coeff=0.01, running_advantage_floor=0.0)
    algorithm = prepared(recipe, tmp_path)
    model, n = algorithm.model, 64
    observation = torch.randn(n, 4)
    steps = TensorDict(
        {
            "action": torch.randint(0, 2, (n,)),
            "action_log_prob": -torch.rand(n) * 1.5,  # far enough off for clipping to act
            "advantage": torch.randn(n, 1) * 3 + 1,
            "value_target": torch.randn(n, 1) * 10,
        },
        [n],
    )
    expected = sb3_style_loss(model, observation, steps, recipe)
    expected_grads = torch.autograd.grad(expected, list(model.parameters()))
    windows = Windows(torch.arange(n).view(n, 1, 1), None)
    minibatch = Minibatch(steps.unsqueeze(1), [observation], windows)
    total, terms = algorithm.objective(minibatch)
    grads = torch.autograd.grad(total, list(model.parameters()))
    assert terms[algorithm.terms.index("clip_fraction")] > 0.1
    assert_near(total, expected)
    for grad, expected_grad in zip(grads, expected_grads, strict=True):
        assert_near(grad, expected_grad)


@pytest.mark.parametrize("setting", ["off", "on"])
def test_the_loss_is_compiled_if_the_recipe_says_so(setting, tmp_path, monkeypatch):
    """What it computes then is in test_rollout.py."""
    monkeypatch.setattr(shutil, "which", lambda name: name)
    monkeypatch.setattr("recipes.ppo.compile_and_time", lambda function, name: name)
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
    monkeypatch.setattr("recipes.compilation._works", lambda: True)
    assert should_compile(setting, steps) is expected


def test_compiling_without_a_compiler_is_refused(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=r"no C\+\+ compiler"):
        should_compile("on", 1)
    with pytest.raises(ValueError, match=r"no C\+\+ compiler"):
        PPOAlgorithm(replace(SMALL, compile="on")).check()


def test_adam_gets_its_settings(monkeypatch, tmp_path):
    seen = {}
    original = torch.optim.Adam.__init__

    def spy(self, parameters, **settings):
        seen.update(settings)
        original(self, parameters, **settings)

    monkeypatch.setattr(torch.optim.Adam, "__init__", spy)
    with Run.create(tmp_path / "run", SMALL) as run:
        train(SMALL, run)
    assert (seen["lr"], seen["eps"]) == (3e-4, 1e-5)
    assert seen.get("weight_decay", 0) == 0


def test_whole_rollouts_cover_the_steps():
    assert RECIPE.final_step == 100_352  # 49 batches of 2048 cover 100k


def test_minibatches_show_every_step_once_an_epoch():
    n = 40
    batch = TensorDict(
        {
            "observation": torch.arange(n).view(2, 20, 1),
            "next": {
                "observation": torch.arange(1, n + 1).view(2, 20, 1),
                "done": torch.zeros(2, 20, 1, dtype=torch.bool),
            },
            "action": torch.arange(n).view(2, 20),
            "action_log_prob": torch.zeros(2, 20),
            "advantage": torch.zeros(2, 20, 1),
            "value_target": torch.zeros(2, 20, 1),
        },
        [2, 20],
    )
    algorithm = PPOAlgorithm(replace(SMALL, epochs=3, minibatch_size=16))
    shown = list(algorithm.minibatches(batch, Rollout(batch, 1, "same")))
    for steps, [frames], windows in shown:
        assert torch.equal(windows.gather(frames).flatten(), steps["action"].flatten())
    parts = [part.steps["action"].flatten().tolist() for part in shown]
    assert [len(part) for part in parts] == [16, 16, 8] * 3
    epochs = [[*parts[i], *parts[i + 1], *parts[i + 2]] for i in (0, 3, 6)]
    assert all(sorted(epoch) == list(range(n)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]


@pytest.mark.numerics
def test_initialisation_is_that_of_stable_baselines3():
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
    with Run.create(tmp_path / "run", SMALL) as run:
        train(SMALL, run)
    updates = [mode for mode in recorder.modes if mode[0] == "update"]
    acts = [mode for mode in recorder.modes if mode[0] == "act"]
    batches, minibatches_each, epochs = 2, 2, 2
    assert len(updates) == batches * minibatches_each * epochs
    # 16 steps of 2 environments in each batch, and the true next observations of its ends.
    assert len(acts) == batches * (16 + 1)
    assert all(training for _, training, _ in updates)
    assert not any(training for _, training, _ in acts)


@pytest.mark.parametrize("decay", [True, False])
def test_schedules_fall_linearly(decay, tmp_path, monkeypatch):
    recipe = replace(
        SMALL,
        total_steps=128,
        decay_learning_rate=decay,
        decay_clip_epsilon=decay,
        entropy_coeff=0.1,
        decay_entropy_coeff=decay,
    )
    ranges, weights = [], []
    forward = ClipPPOLoss.forward

    def spy(self, *args, **kwargs):
        ranges.append(round(self.clip_epsilon.item(), 6))
        weights.append(round(self.entropy_coeff.item(), 6))
        return forward(self, *args, **kwargs)

    monkeypatch.setattr(ClipPPOLoss, "forward", spy)
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
    rows = (run.folder / "metrics.csv").read_text().splitlines()
    column = rows[0].split(",").index("learning_rate")
    rates = [float(row.split(",")[column]) for row in rows[1:]]
    fractions = [1, 0.75, 0.5, 0.25] if decay else [1, 1, 1, 1]
    assert rates == pytest.approx([3e-4 * fraction for fraction in fractions])
    assert sorted(set(ranges)) == sorted({round(0.2 * fraction, 6) for fraction in fractions})
    assert sorted(set(weights)) == sorted({round(0.1 * fraction, 6) for fraction in fractions})


def test_continuous_actions_are_stored_unclipped_and_evaluated_at_the_mean():
    algorithm = PPOAlgorithm(replace(SMALL, env="Pendulum-v1"))
    env, policy = algorithm.make_env(2, seed=0), algorithm.policy
    with torch.no_grad():
        td = policy(env.reset())
    assert_near(td["scale"], torch.ones_like(td["scale"]))  # log std 0
    collector = Collector(
        env,
        policy,
        frames_per_batch=400,
        total_frames=400,
        auto_register_policy_transforms=False,
    )
    batch = next(iter(collector))
    assert batch["action"].abs().max() > 2.0  # Pendulum's bounds are +-2
    dist = torch.distributions.Normal(batch["loc"], batch["scale"])
    assert_near(batch["action_log_prob"], dist.log_prob(batch["action"]).sum(-1))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        td = policy(env.reset())
    assert_near(td["action"], td["loc"])


def test_gradient_is_scaled_to_its_largest_norm(monkeypatch, tmp_path):
    seen = []
    clip = nn.utils.clip_grad_norm_

    def spy(parameters, max_norm):
        norm = clip(parameters, max_norm)
        seen.append(parameters.grad.norm())  # of all parameters, which lie in one tensor
        assert max_norm == 0.5
        return norm

    monkeypatch.setattr(nn.utils, "clip_grad_norm_", spy)
    with Run.create(Path(tmp_path) / "run", SMALL) as run:
        train(SMALL, run)
    assert max(seen) <= 0.5 + 1e-4
