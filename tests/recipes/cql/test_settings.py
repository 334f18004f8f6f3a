"""Recipes of conservative Q-learning: the paper's settings, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recipes.cli import main
from recipes.cql import CQL
from recipes.recipe import recipe_from_json, recipe_to_json
from recipes.registry import RECIPES, get_recipe
from tests.datasets.rollouts import roll, write
from tests.recipes.cql.cql_runs import make_cql, make_discrete_cql
from tests.recipes.offline.sequence_runs import make_data
from torchrl_tit.networks import CatformerConfig, EnhancedTITConfig, MLPConfig

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
    mlp, tit = (get_recipe(f"cql/{data}-v0/{network}") for network in ("mlp", "enhanced-tit"))
    for recipe in (mlp, tit):
        assert isinstance(recipe, CQL)
        assert recipe.dataset == f"{data}-v0"
        assert recipe.env.lower().startswith(task)
        rates = (recipe.actor_learning_rate, recipe.critic_learning_rate)
        assert (*rates, recipe.temperature_learning_rate) == (1e-4, 3e-4, 1e-4)
        assert (recipe.temperature_init, recipe.adam_eps) == (1.0, 1e-8)
        # 10 for the medium sets of version 0.
        assert recipe.conservative_weight == (5.0 if data.endswith("replay") else 10.0)
        assert (recipe.batch_size, recipe.action_samples) == (256, 10)
        assert (recipe.gamma, recipe.tau) == (0.99, 0.005)
        assert (recipe.critic, recipe.critic_hidden) == ("mlp", (256, 256, 256))
        assert (recipe.history, recipe.over_critics) == (1, "mean")
        assert (recipe.time_limits, recipe.terminal_observations) == ("drop", "zero")
        assert recipe.unfinished == "drop"
        assert (recipe.final_step, recipe.evaluation_interval) == (500_000, 1000)
        assert recipe.evaluation_episodes == 10
        assert recipe_from_json(recipe_to_json(recipe), "it") == recipe
    assert mlp.backbone == MLPConfig(hidden_dim=256, num_layers=3, activation="relu")
    config = tit.backbone
    assert isinstance(config, EnhancedTITConfig)
    assert RELEASED[data] == (
        config.num_blocks,
        config.features_dim,
        config.embed_dim,
        config.num_heads_outer,
        config.attention_dropout_outer,
        config.ffn_dropout_outer,
        config.activation_head,
        config.ffn_expansion_outer,
        config.share_blocks,
    )
    assert config.patch_size == SIZES[task]  # the whole observation
    assert (config.num_heads_inner, config.ffn_expansion_inner) == (1, 1)
    assert (config.attention_dropout_inner, config.ffn_dropout_inner) == (0, 0)
    assert (config.activation_inner, config.activation_outer) == ("gelu", "gelu")
    assert (config.position_encoding, config.temporal_position_encoding) == (False, False)


def test_there_are_no_other_named_recipes():
    names = {f"cql/{data}-v0/{network}" for data in RELEASED for network in ("mlp", "enhanced-tit")}
    assert {name for name in RECIPES if name.startswith("cql/")} == names


def refused(recipe, folder, capsys):
    """What the command line says of a recipe; nothing is written."""
    path = folder / "recipe.json"
    path.write_text(recipe_to_json(recipe))
    with pytest.raises(SystemExit) as stop:
        main(["train", str(path), "--out", str(folder / "run")])
    assert stop.value.code == 2
    assert not (folder / "run").exists()
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"env": "CartPole-v1"},
            "error: cql needs continuous actions within bounds, but those of CartPole-v1 are "
            "discrete",
        ),
        ({"env": "ALE/Pong-v5"}, "those of ALE/Pong-v5 are discrete"),
        ({"env": "Hoper-v5"}, "Unknown task 'Hoper-v5'; did you mean one of 'Hopper-v5'"),
        ({"env": "Walker2d-v5"}, "[11], but in Walker2d-v5 it is [17]; these data are of another"),
        ({"dataset": "hopper"}, "'hopper' is no data set: give an HDF5 file"),
        ({"dataset": "./no.hdf5"}, "no.hdf5"),
        (
            {"backbone": CatformerConfig()},
            "a catformer is a transformer over time: set history to 2 or more, not 1",
        ),
        (
            {"backbone": EnhancedTITConfig(temporal_position_encoding=True)},
            "no temporal positions in one observation: set history to more",
        ),
        (
            {"backbone": EnhancedTITConfig(num_heads_inner=3)},
            "the width 32 cannot be split over 3 attention heads",
        ),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(
    tmp_path, capsys, settings, message
):
    assert message in refused(make_cql(tmp_path, **settings), tmp_path, capsys)


def test_data_of_the_other_kind(tmp_path, capsys):
    discrete = make_discrete_cql(tmp_path)
    message = refused(replace(discrete, env="Hopper-v5"), tmp_path, capsys)
    assert "discrete-cql needs a few discrete actions, but those of Hopper-v5 are cont" in message
    message = refused(replace(discrete, dataset=str(make_data(tmp_path))), tmp_path, capsys)
    assert "these data are of another task" in message
    message = refused(make_cql(tmp_path, dataset=discrete.dataset), tmp_path, capsys)
    assert "these data are of another task" in message


def test_actions_of_the_right_shape_but_the_other_kind(tmp_path):
    floats = roll(task="CartPole-v1", max_episode_steps=20)
    floats["actions"] = floats["actions"][:, None] * np.float32(0.5)
    data = str(write(tmp_path / "floats.hdf5", floats))
    message = "are floats, but those of CartPole-v1 are integers: take other data"
    with pytest.raises(ValueError, match=message):
        make_discrete_cql(tmp_path, dataset=data).check()
    integers = roll()
    integers["actions"] = np.sign(integers["actions"]).astype(np.int64)
    data = str(write(tmp_path / "integers.hdf5", integers))
    message = "are integers, but those of Hopper-v5 are floats: take other data"
    with pytest.raises(ValueError, match=message):
        make_cql(tmp_path, dataset=data).check()


def test_files_that_do_not_mark_time_limits(tmp_path):
    rolled = roll()
    bare = {name: rolled[name] for name in ("observations", "actions", "rewards", "terminals")}
    bare["terminals"] = np.zeros_like(bare["terminals"])
    data = str(write(tmp_path / "bare.hdf5", bare))
    with pytest.raises(ValueError, match=r"no episode ends in its .* give max_episode_steps"):
        make_cql(tmp_path, dataset=data).check()
    limited = make_cql(tmp_path, dataset=data, max_episode_steps=20, unfinished="keep")
    steps = len(rolled["rewards"])
    assert len(limited.make_buffer()) == steps - math.ceil(steps / 20)  # the last of each

    rolled["next_observations"] = rolled["next_observations"] + np.float32(1)
    data = str(write(tmp_path / "torn.hdf5", rolled))
    with pytest.raises(ValueError, match='gaps="cut" ends it there'):
        make_cql(tmp_path, dataset=data).check()
    recipe = make_cql(tmp_path, dataset=data, gaps="cut", time_limits="keep")
    assert len(recipe.make_buffer()) == steps


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"history": 0}, "history must be at least 1, not 0"),
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
def test_impossible_settings_of_both(tmp_path, make, settings, message):
    with pytest.raises(ValueError, match=message):
        make(tmp_path, **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action_samples": 0}, "action_samples must be at least 1, not 0"),
        ({"temperature_init": 0.0}, r"temperature_init must be positive, not 0\.0"),
        ({"critic_hidden": ()}, r"critic_hidden must be at least one width .*, not \(\)"),
        ({"critic_hidden": (8, 0)}, r"critic_hidden must be at least one width .*, not \(8, 0\)"),
        ({"actor_learning_rate": -1.0}, "actor_learning_rate must be at least 0"),
        ({"critic_learning_rate": -1.0}, "critic_learning_rate must be at least 0"),
        ({"temperature_learning_rate": -1.0}, "temperature_learning_rate must be at least 0"),
        ({"critic": "tit"}, r"field 'critic' is 'tit', not one of \('mlp', 'backbone'\)"),
    ],
)
def test_impossible_settings(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        make_cql(tmp_path, **settings)


def test_an_unknown_way_over_critics(tmp_path):
    message = r"field 'over_critics' is 'max', not one of \('mean', 'sum'\)"
    with pytest.raises(ValueError, match=message):
        make_cql(tmp_path, over_critics="max").check()
