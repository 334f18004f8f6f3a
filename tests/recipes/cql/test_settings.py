"""Recipes of conservative Q-learning: the paper's settings, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recipes.cli import main
from recipes.cql import CQL
from recipes.recipe_json import recipe_from_json, recipe_to_json
from recipes.registry import RECIPES, get_recipe
from tests.datasets.rollouts import roll, write
from tests.recipes.cql.cql_runs import make_algorithm, make_cql, make_discrete_cql, tit
from tests.recipes.dataset_runs import make_data
from torchrl_tit.settings import Inner, PairedOuter
from torchrl_tit.settings.networks import catformer, lstm, mlp, nature_cnn

# What the authors of arXiv 2212.14538 released: blocks, features, width, outer heads, dropout of
# outer attention and FFN, activation of the head, outer expansion, shared blocks.
RELEASED: dict[str, tuple[Any, ...]] = {
    "halfcheetah-medium": (2, 512, 256, 4, 0, 0.1, "gelu", 1, False),
    "hopper-medium": (1, 512, 32, 2, 0, 0, "relu", 1, True),
    "walker2d-medium": (1, 512, 32, 2, 0, 0, "relu", 1, True),
    "halfcheetah-medium-replay": (2, 1024, 128, 2, 0, 0, "tanh", 1, True),
    "hopper-medium-replay": (2, 1024, 128, 1, 0.1, 0, "relu", 1, True),
    "walker2d-medium-replay": (2, 512, 32, 2, 0, 0, "relu", 2, True),
}
SIZES = {"halfcheetah": 17, "hopper": 11, "walker2d": 17}


@pytest.mark.parametrize("data", RELEASED)
def test_named_recipes_have_the_papers_settings(data):
    task = data.split("-")[0]
    small, tit = (get_recipe(f"cql/{data}-v0/{network}") for network in ("mlp", "enhanced-tit"))
    for recipe in (small, tit):
        assert isinstance(recipe, CQL)
        assert recipe.dataset == f"{data}-v0"
        assert recipe.env.lower().startswith(task)
        rates = (recipe.actor_learning_rate, recipe.critic_learning_rate)
        assert (*rates, recipe.temperature_learning_rate) == (1e-4, 3e-4, 1e-4)
        # 10 for the medium sets of version 0.
        assert recipe.conservative_weight == (5.0 if data.endswith("replay") else 10.0)
        assert (recipe.batch_size, recipe.action_samples) == (256, 10)
        assert (recipe.gamma, recipe.tau) == (0.99, 0.005)
        assert (recipe.critic, recipe.critic_hidden) == ("mlp", (256, 256, 256))
        assert (recipe.backbone.num_frames, recipe.over_critics) == (1, "mean")
        assert (recipe.time_limits, recipe.unfinished) == ("drop", "drop")
        assert (recipe.final_step, recipe.evaluation_interval) == (500_000, 1000)
        assert (recipe.log_interval, recipe.checkpoint_interval) == (100, 1000)
        assert recipe.evaluation_episodes == 10
        assert recipe_from_json(recipe_to_json(recipe), "it") == recipe
    assert small.backbone == mlp(hidden_dim=256, num_layers=3, activation="relu")
    inner, outer, head = tit.backbone.frame, tit.backbone.history, tit.backbone.head
    assert isinstance(inner, Inner)
    assert isinstance(outer, PairedOuter)
    assert RELEASED[data] == (
        inner.num_blocks,
        head.features_dim,
        inner.embed_dim,
        outer.num_heads,
        outer.attention_dropout,
        outer.ffn_dropout,
        head.activation,
        outer.ffn_expansion,
        inner.share_blocks,
    )
    assert outer.share_blocks == inner.share_blocks
    assert inner.patch_size == SIZES[task]  # the whole observation
    assert (inner.num_heads, inner.ffn_expansion) == (1, 1)
    assert (inner.attention_dropout, inner.ffn_dropout) == (0, 0)
    assert (inner.activation, outer.activation) == ("gelu", "gelu")
    assert (inner.position_encoding, outer.temporal_positions) == (False, "none")
    assert inner.every_block
    assert head.norm
    assert (tit.backbone.initialization, tit.backbone.trunks) == ("normal", "shared")


def test_discrete_recipes_have_the_settings_of_their_results():
    """docs/results/discrete_cql.md."""
    names = ["cartpole-mixed/mlp", "cartpole-mixed/enhanced-tit"]
    cartpole: list[Any] = [get_recipe(f"discrete-cql/{name}") for name in names]
    names = ["pong-mixed/nature-cnn", "pong-mixed/enhanced-tit"]
    pong: list[Any] = [get_recipe(f"discrete-cql/{name}") for name in names]
    for recipe in cartpole:
        assert (recipe.env, recipe.dataset) == ("CartPole-v1", "data/cartpole/mixed.hdf5")
        assert (recipe.batch_size, recipe.learning_rate, recipe.tau) == (64, 3e-4, 0.005)
        assert (recipe.final_step, recipe.evaluation_interval) == (10_000, 1000)
        assert (recipe.evaluation_episodes, recipe.padding) == (20, "same")
        assert recipe.backbone.num_frames == 1
    for recipe in pong:
        assert (recipe.env, recipe.dataset) == ("ALE/Pong-v5", "data/pong/mixed.hdf5")
        assert (recipe.batch_size, recipe.learning_rate, recipe.tau) == (32, 1e-4, 0.005)
        assert (recipe.final_step, recipe.evaluation_interval) == (20_000, 4000)
        assert (recipe.evaluation_episodes, recipe.padding) == (5, "constant")
        assert recipe.backbone.num_frames == 4
    for recipe in (*cartpole, *pong):
        assert (recipe.conservative_weight, recipe.gamma) == (1.0, 0.99)
    assert cartpole[1].backbone.frame.patch_size == 2
    assert pong[1].backbone == get_recipe("ppo/pong/enhanced-tit").backbone


def test_there_are_no_other_named_recipes():
    names = {f"cql/{data}-v0/{network}" for data in RELEASED for network in ("mlp", "enhanced-tit")}
    assert {name for name in RECIPES if name.startswith("cql/")} == names


def refused(recipe):
    """What the checks before a run say of a recipe."""
    with pytest.raises((ValueError, FileNotFoundError)) as refusal:
        make_algorithm(recipe).check()
    return str(refusal.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"env": "CartPole-v1"},
            "cql needs continuous actions within bounds, but those of CartPole-v1 are discrete",
        ),
        ({"env": "ALE/Pong-v5"}, "those of ALE/Pong-v5 are discrete"),
        ({"env": "Hoper-v5"}, "did you mean 'Hopper-v5'"),
        ({"env": "Walker2d-v5"}, "[11], but in Walker2d-v5 it is [17]"),
        ({"dataset": "hopper"}, "'hopper' is not a data set: give an HDF5 file"),
        ({"dataset": "./no.hdf5"}, "no.hdf5"),
        (
            {"backbone": tit(num_heads_inner=3)},
            "the width 8 cannot be split over 3 attention heads",
        ),
        ({"backbone": nature_cnn()}, "(11,) is that of an array, but this encoder reads images"),
    ],
)
def test_what_does_not_fit_is_refused_before_a_run(tmp_path, settings, message):
    assert message in refused(make_cql(tmp_path, **settings))


def test_the_command_line_refuses_before_anything_is_written(tmp_path, capsys):
    path = tmp_path / "recipe.json"
    path.write_text(recipe_to_json(make_cql(tmp_path, env="CartPole-v1")))
    with pytest.raises(SystemExit) as stop:
        main(["train", str(path), "--out", str(tmp_path / "run")])
    assert stop.value.code == 2
    assert not (tmp_path / "run").exists()
    assert "error: cql needs continuous actions within bounds" in capsys.readouterr().err


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_a_network_that_carries_a_state(tmp_path, make):
    message = "draws single transitions, .* set backbone.num_frames to 2 or more"
    with pytest.raises(ValueError, match=message):
        make(tmp_path, backbone=lstm())
    make(tmp_path, backbone=lstm(2))


def test_a_transformer_over_time_needs_several_frames():
    with pytest.raises(ValueError, match="num_frames is 1: set it to 2 or more"):
        catformer(1)
    with pytest.raises(ValueError, match="temporal_positions 'learned' tells frames apart"):
        tit(temporal_positions="learned")


def test_data_of_another_task(tmp_path):
    discrete = make_discrete_cql(tmp_path)
    message = refused(replace(discrete, env="Hopper-v5"))
    assert "discrete-cql needs a few discrete actions, but those of Hopper-v5 are cont" in message
    for recipe in (
        replace(discrete, dataset=str(make_data(tmp_path))),
        make_cql(tmp_path, dataset=discrete.dataset),
    ):
        assert "another task" in refused(recipe)


def test_actions_of_the_right_shape_but_the_other_kind(tmp_path):
    floats = roll(task="CartPole-v1", max_episode_steps=20)
    floats["actions"] = floats["actions"][:, None] * np.float32(0.5)
    data = str(write(tmp_path / "floats.hdf5", floats))
    message = "are floats, but those of CartPole-v1 are integers: use other data"
    with pytest.raises(ValueError, match=message):
        make_algorithm(make_discrete_cql(tmp_path, dataset=data)).check()
    integers = roll()
    integers["actions"] = np.sign(integers["actions"]).astype(np.int64)
    data = str(write(tmp_path / "integers.hdf5", integers))
    message = "are integers, but those of Hopper-v5 are floats: use other data"
    with pytest.raises(ValueError, match=message):
        make_algorithm(make_cql(tmp_path, dataset=data)).check()


def test_files_that_do_not_mark_time_limits(tmp_path):
    rolled = roll()
    bare = {name: rolled[name] for name in ("observations", "actions", "rewards", "terminals")}
    bare["terminals"] = np.zeros_like(bare["terminals"])
    data = str(write(tmp_path / "bare.hdf5", bare))
    with pytest.raises(ValueError, match=r"no episode ends in its .* give max_episode_steps"):
        make_algorithm(make_cql(tmp_path, dataset=data)).check()
    limited = make_cql(tmp_path, dataset=data, max_episode_steps=20, unfinished="keep")
    steps = len(rolled["rewards"])
    assert len(make_algorithm(limited).make_buffer()) == steps - math.ceil(
        steps / 20
    )  # the last of each

    rolled["next_observations"] = rolled["next_observations"] + np.float32(1)
    data = str(write(tmp_path / "torn.hdf5", rolled))
    with pytest.raises(ValueError, match='gaps="cut"'):
        make_algorithm(make_cql(tmp_path, dataset=data)).check()
    recipe = make_cql(tmp_path, dataset=data, gaps="cut", time_limits="keep")
    assert len(make_algorithm(recipe).make_buffer()) == steps


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"slice_length": 0}, "slice_length must be at least 1, not 0"),
        ({"slice_length": 2, "compile": "on"}, "compile is on, but slices of 2 are not compiled"),
        ({"slice_length": 3}, "slice_length 3 does not divide batch_size 8: change one of them"),
        ({"padding": "zeros"}, r"field 'padding' is 'zeros', not one of \('same', 'constant'\)"),
        ({"gaps": "keep"}, r"field 'gaps' is 'keep', not one of \('error', 'cut'\)"),
        ({"time_limits": "cut"}, r"field 'time_limits' is 'cut'"),
        ({"log_interval": 0}, "log_interval must be at least 1, not 0"),
        ({"checkpoint_interval": 0}, "checkpoint_interval must be at least 1, not 0"),
        ({"total_updates": 0}, "total_updates must be at least 1, not 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, not 0"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, not 0"),
        ({"gamma": 1.01}, r"gamma must be at most 1, not 1\.01"),
        ({"gamma": float("nan")}, "gamma must be at least 0, not nan"),
        ({"tau": -0.1}, r"tau must be at least 0, not -0\.1"),
        ({"conservative_weight": -1.0}, "conservative_weight must be at least 0"),
        ({"evaluation_interval": 0}, "evaluation_interval must be at least 1"),
    ],
)
@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_impossible_settings_of_either(tmp_path, make, settings, message):
    with pytest.raises(ValueError, match=message):
        make(tmp_path, **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action_samples": 0}, "action_samples must be at least 1, not 0"),
        ({"critic_hidden": ()}, r"critic_hidden must be at least one width .*, not \(\)"),
        ({"critic_hidden": (8, 0)}, r"critic_hidden must be at least one width .*, not \(8, 0\)"),
        ({"actor_learning_rate": -1.0}, "actor_learning_rate must be at least 0"),
        ({"critic_learning_rate": -1.0}, "critic_learning_rate must be at least 0"),
        ({"temperature_learning_rate": -1.0}, "temperature_learning_rate must be at least 0"),
        ({"over_critics": "max"}, r"'over_critics' is 'max', not one of \('mean', 'sum'\)"),
        ({"critic": "tit"}, r"field 'critic' is 'tit', not one of \('mlp', 'backbone'\)"),
    ],
)
def test_impossible_settings(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        make_cql(tmp_path, **settings)
