"""PPO on observations and actions of all kinds, with masks, and recipes for any task."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from recipes.cli import main, training
from recipes.core.algorithm import make_algorithm
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import get_recipe
from recipes.core.run import Run
from recipes.ppo import PPO, PPOAlgorithm
from tests.numerics import assert_near
from tests.recipes.ppo import tasks
from tests.recipes.ppo.algorithms import perturb
from tests.recipes.small import train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings import Flat, Inner, Linear
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

SMALL: dict[str, Any] = {"embed_dim": 8, "features_dim": 8}
TIT = enhanced_tit(3, patch_size="auto", num_blocks=1, **SMALL)
RECIPE = PPO(
    env="CartPole-v1",
    backbone=TIT,
    num_envs=2,
    total_steps=64,
    steps_per_batch=32,
    minibatch_size=16,
    epochs=1,
    evaluation_episodes=2,
    compile="off",
)
SPLIT = "tests.recipes.ppo.tasks:Split"
TASKS: dict[str, dict[str, Any]] = {
    **{name: {"env": f"{name}Actions-v0"} for name in tasks.ACTIONS},
    "masked Discrete": {"env": "DiscreteActions-v0", "mask_actions": True},
    "masked MultiDiscrete": {"env": "MultiDiscreteActions-v0", "mask_actions": True},
    "one frame": {"env": "MultiDiscreteActions-v0", "backbone": replace(TIT, num_frames=1)},
    "lstm": {"env": "MultiBinaryActions-v0", "backbone": lstm(hidden_dim=8, **SMALL)},
    "Split": {"wrappers": (SPLIT,), "padding": "constant"},
}


def trained(recipe, folder):
    """The networks after training, and the rows of metrics without their times."""
    run = train(recipe, folder)
    rows = [line.split(",") for line in (run.folder / "metrics.csv").read_text().splitlines()]
    weights = TensorDict(load_checkpoint(run.checkpoints)[1]["networks"])
    return weights, [[row[0], *row[3:]] for row in rows]


@pytest.mark.numerics
@pytest.mark.parametrize("name", TASKS)
def test_training_sees_what_the_policy_saw(name, tmp_path):
    """Values and log-probabilities of minibatches are those that were collected.

    So histories of several observations, states, masks and actions are those that the policy read
    and wrote. Only allowed actions were taken, and a full run, which evaluates, has finite metrics.
    """
    recipe = replace(RECIPE, **TASKS[name])
    algorithm = PPOAlgorithm(recipe)
    model = algorithm.model
    perturb(model)
    algorithm.prepare(0, tmp_path)
    with torch.no_grad():
        batches = iter(algorithm.batches())
        next(batches)
        batch = next(batches)
        algorithm.close()
        assert not any("history" in str(key) for key in batch.keys(True))
        assert batch["action_log_prob"].isfinite().all()
        rollout = algorithm.rollout(batch)
        assert rollout.is_init.any()
        assert "observation" not in batch
        algorithm.advantages(batch, rollout)
        spread = batch["state_value"].std()
        for minibatch, frames, windows in algorithm.minibatches(batch, rollout):
            algorithm._encode(minibatch, frames, windows)
            value = model.critic(minibatch)["state_value"]
            assert_near(value, minibatch["value_target"] - minibatch["advantage"])
            assert_near(model.actor.log_prob(minibatch), minibatch["action_log_prob"])
            if recipe.mask_actions:
                sizes = [3, 2, 4] if "Multi" in name else [3]
                masks = minibatch["action_mask"].split(sizes, -1)
                choices = minibatch["action"].reshape(*minibatch.shape, -1).unbind(-1)
                for mask, choice in zip(masks, choices, strict=True):
                    assert mask.gather(-1, choice.unsqueeze(-1)).all()
                    assert not mask.all()
        assert spread > 1e-3

    _, (_, *rows) = trained(recipe, tmp_path / "run")
    numbers = [float(cell) for row in rows for cell in row[2:]]  # maybe no episode ended
    assert numbers
    assert all(map(math.isfinite, numbers))


def test_an_observation_in_parts_trains_as_a_whole(tmp_path):
    """Flat frames of the parts, side by side, are that of the whole: so are all later weights."""
    network = mlp(3, hidden_dim=8)
    whole = replace(RECIPE, backbone=network)
    parts = replace(
        whole, backbone=replace(network, frames={"cart": Flat(), "pole": Flat()}), wrappers=(SPLIT,)
    )
    weights, rows = trained(whole, tmp_path / "whole")
    other, other_rows = trained(parts, tmp_path / "parts")
    assert (weights == other).all()
    assert rows == other_rows


TASK = next(f"{name}Actions-v0" for name in tasks.ACTIONS)
NAMES = ["ppo/enhanced-tit", "ppo/vanilla-tit", "ppo/mlp", "ppo/lstm"]


@pytest.mark.parametrize("env", [TASK, "FrozenLake-v1"])
@pytest.mark.parametrize("name", NAMES)
def test_the_name_of_a_task_is_enough(name, env):
    make_algorithm(replace(get_recipe(name), env=env)).check()


def test_what_was_chosen_is_printed_and_recorded(monkeypatch, tmp_path, capsys):
    runs: list[Run] = []
    monkeypatch.setattr(training, "_finish", lambda run, *_: runs.append(run))
    words = ["--env", TASK, "--backbone.frames.state/0", "linear", "--out", str(tmp_path / "run")]
    main(["train", "ppo/mlp", *words, "--backbone.frames.state/0.embed-dim", "8"])
    assert capsys.readouterr().out == (
        "frames chosen by kind of observation: image: inner (embed_dim 8, "
        "every_block False, patch_size auto); state/1: linear (embed_dim 8, bias True)\n"
    )
    (run,) = runs
    frames = {
        "image": Inner(embed_dim=8, patch_size="auto", every_block=False),
        "state/0": Linear(embed_dim=8),
        "state/1": Linear(embed_dim=8, bias=True),
    }
    assert run.recipe.backbone.frames == frames
    recipe = recipe_from_json((tmp_path / "run" / "recipe.json").read_text(), "it")
    assert recipe == run.recipe
    modules = make_algorithm(recipe).policy.modules()
    network = next(module for module in modules if isinstance(module, HistoryNetwork))
    assert network.frame_settings == frames


@pytest.mark.parametrize(("std", "expected"), [(None, 1.0), (0.5, 0.5 * 2)])
def test_the_deviation_starts_as_a_share_of_the_tasks_range(std, expected):
    """Although the environment clips, so that the bounds are not in its spec."""
    algorithm: Any = make_algorithm(replace(RECIPE, env="Pendulum-v1", initial_std=std))
    features = torch.zeros(1, algorithm.model.backbone.features_dim)
    step = algorithm.model.actor(TensorDict({"features": features}, [1]))
    assert_near(step["scale"], torch.full((1, 1), expected))


def test_recipes_with_frames_have_a_hash_and_json():
    recipe = get_recipe("ppo/enhanced-tit")
    frames = {"image": Inner(patch_size="auto"), "arm/left": Linear()}
    named = replace(recipe, backbone=replace(enhanced_tit(), frames=frames))
    same = replace(recipe, backbone=replace(enhanced_tit(), frames=dict(reversed(frames.items()))))
    assert named == same
    assert len({recipe: 1, named: 2, same: 3}) == 2
    assert recipe_from_json(recipe_to_json(named), "it") == named
