"""Fewer actions."""

import gymnasium
import pytest
from gymnasium.spaces import Discrete

from torchrl_tit.tasks import FirstActions


def test_the_others_are_gone():
    env = FirstActions(gymnasium.make("Taxi-v4"), 4)
    assert env.action_space == Discrete(4)
    env.reset(seed=0)
    expected = gymnasium.make("Taxi-v4")
    expected.reset(seed=0)
    for action in (0, 3, 2, 1):
        assert env.step(action)[0] == expected.step(action)[0]


@pytest.mark.parametrize("count", [0, 7])
def test_bad_counts(count):
    with pytest.raises(ValueError, match=f"from 1 to 6, the task's actions, not {count}"):
        FirstActions(gymnasium.make("Taxi-v4"), count)


def test_other_kinds_of_actions():
    with pytest.raises(ValueError, match="needs Discrete actions, not Box"):
        FirstActions(gymnasium.make("Pendulum-v1"), 1)


def test_a_spec_recreates_it():
    env = FirstActions(gymnasium.make("Taxi-v4"), 4)
    assert env.spec is not None
    again = gymnasium.make(env.spec)
    assert again.action_space == Discrete(4)
    assert again.spec == env.spec
