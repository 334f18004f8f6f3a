"""Recipes of conservative Q-learning: the paper's settings, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import torch

from tests.datasets.rollouts import roll, write
from tests.recipes.small import make_algorithm, make_cql, tit


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
    for padding, empty in (("same", False), ("constant", True)):
        padded = make_cql(tmp_path, backbone=tit(3), padding=padding)
        history = make_algorithm(padded).make_buffer().storage.get(torch.tensor([0]))["history"]
        assert (not history[:, :-1].any()) == empty
