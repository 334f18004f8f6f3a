"""What was done and got in the step before, as an observation."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import pytest
import torch
from gymnasium import spaces

from recipes.core.registry import get_recipe
from recipes.core.trust import check_names
from torchrl_tit.envs import make_env
from torchrl_tit.tasks import PreviousStep

WRAPPER = "torchrl_tit.tasks:PreviousStep"


def test_each_step_is_seen_in_the_next_and_none_at_the_start_of_an_episode() -> None:
    """Over several episodes of several copies, in histories as well."""
    env = make_env("CartPole-v1", 3, seed=0, num_frames=4, wrappers=[WRAPPER])
    steps = env.rollout(60, break_when_any_done=False)
    seen = steps["observation"]
    ended = steps["next", "done"][:, :-1]
    assert ended.sum() >= 3
    taken = torch.nn.functional.one_hot(steps["action"], 2)[:, :-1].float()
    expected = torch.where(
        ended, torch.zeros(()), torch.cat([taken, steps["next", "reward"][:, :-1]], -1)
    )
    actual = torch.cat([seen["previous_action"], seen["previous_reward"]], -1)
    torch.testing.assert_close(actual[:, 1:], expected)
    assert not actual[:, 0].any()
    assert torch.equal(steps["history", "previous_action"][..., -1, :], seen["previous_action"])


def test_velocities_are_hidden_beside_it() -> None:
    """The task's own observation is that of the task."""
    env = make_env("CartPole-v1", num_frames=4, hide_velocities=True, wrappers=[WRAPPER])
    shapes = {name: tuple(value.shape) for name, value in env.reset()["history"].items()}
    expected = {
        "observation": (1, 4, 2),
        "previous_action": (1, 4, 2),
        "previous_reward": (1, 4, 1),
    }
    assert shapes == expected


class Named(gymnasium.Env):
    """A task with an observation of a name and an action."""

    def __init__(self, name: str, action: spaces.Space) -> None:
        self.observation_space = spaces.Dict({name: spaces.Discrete(2)})
        self.action_space = action


def test_names_and_actions() -> None:
    """Names that the task already has, and actions of no fixed size, are refused."""
    parts = spaces.MultiDiscrete([2, 3])
    with pytest.raises(ValueError, match="already has an observation 'previous_reward'"):
        PreviousStep(Named("previous_reward", parts))
    seen = PreviousStep(Named("a", parts)).observation_space
    assert isinstance(seen, spaces.Dict)
    shapes = {name: space.shape for name, space in seen.items()}
    assert shapes == {"a": (), "previous_action": (5,), "previous_reward": (1,)}
    with pytest.raises(ValueError, match="cannot observe actions of Sequence"):
        PreviousStep(Named("a", spaces.Sequence(spaces.Discrete(2))))


def test_a_file_may_name_it() -> None:
    """It only computes."""
    recipe = replace(get_recipe("ppo/tmaze-10/enhanced-tit"), wrappers=(WRAPPER,))
    check_names(recipe, "recipe.json")
