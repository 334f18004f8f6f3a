"""Stable-Baselines3's checker finds nothing to say about our tasks."""

from collections.abc import Callable

import gymnasium
import pytest
from stable_baselines3.common.env_checker import check_env

from torchrl_tit.tasks import FirstActions, TMaze


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "make",
    [
        lambda: TMaze(3),
        lambda: TMaze(3, render_mode="rgb_array", end_when_behind=True),
        lambda: gymnasium.make("TMaze-v0", corridor_length=1),
        lambda: FirstActions(gymnasium.make("FrozenLake-v1"), count=3),
    ],
    ids=["t-maze", "t-maze-that-ends", "registered", "first-actions"],
)
def test_stable_baselines3(make: Callable[[], gymnasium.Env]) -> None:
    check_env(make())
