"""Recipes of conservative Q-learning: the paper's settings, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.datasets.rollouts import roll, write
from tests.recipes.cql.cql_runs import make_algorithm, make_cql, make_discrete_cql, tit
from tests.recipes.dataset_runs import make_data
from torchrl_tit.settings.networks import lstm, nature_cnn


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


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_a_network_that_carries_a_state(tmp_path, make):
    message = "draws single transitions, .* set backbone.num_frames to 2 or more"
    with pytest.raises(ValueError, match=message):
        make(tmp_path, backbone=lstm())
    make(tmp_path, backbone=lstm(2))


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


def test_how_the_data_are_read_is_passed_on(tmp_path):
    """Files without time limits, and with gaps."""
    rolled = roll()
    names = ("observations", "actions", "rewards", "terminals")
    bare = {name: rolled[name] for name in names}
    bare["terminals"] = np.zeros_like(bare["terminals"])
    data, steps = str(write(tmp_path / "bare.hdf5", bare)), len(rolled["rewards"])
    limited = make_cql(tmp_path, dataset=data, max_episode_steps=20, unfinished="keep")
    dropped = math.ceil(steps / 20)  # the last of each
    assert len(make_algorithm(limited).make_buffer()) == steps - dropped
    rolled["next_observations"] = rolled["next_observations"] + np.float32(1)
    data = str(write(tmp_path / "torn.hdf5", rolled))
    recipe = make_cql(tmp_path, dataset=data, gaps="cut", time_limits="keep")
    assert len(make_algorithm(recipe).make_buffer()) == steps


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"slice_length": 2, "compile": "on"}, "compile is on, but slices of 2 are not compiled"),
        ({"slice_length": 3}, "slice_length 3 does not divide batch_size 8: change one of them"),
        ({"gaps": "keep"}, r"field 'gaps' is 'keep', not one of \('error', 'cut'\)"),
        ({"gamma": float("nan")}, "gamma must be at least 0, not nan"),
        ({"tau": -0.1}, r"tau must be at least 0, not -0\.1"),
        ({"critic_hidden": (8, 0)}, r"critic_hidden must be at least one width .*, not \(8, 0\)"),
        ({"over_critics": "max"}, r"'over_critics' is 'max', not one of \('mean', 'sum'\)"),
    ],
)
def test_impossible_settings(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        make_cql(tmp_path, **settings)
