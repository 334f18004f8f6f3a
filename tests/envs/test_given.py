"""Tasks whose observations come from outside."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs.utils import check_env_specs

from torchrl_tit.envs import make_env, time_limit
from torchrl_tit.envs.given import GivenTask


@pytest.mark.parametrize(
    "spaces",
    [
        {"observation_shape": [5], "low": [-1, 0], "high": [1, 7]},
        {"observation_shape": [12, 12], "observation_dtype": "uint8", "num_actions": 3},
    ],
    ids=["arrays", "images"],
)
def test_a_task_without_a_name_is_like_any_other(spaces):
    env = make_env("", 3, num_frames=2, clip_actions=False, **spaces)
    check_env_specs(env)
    first = env.reset()["observation"]
    assert first.shape == (3, *spaces["observation_shape"])
    assert not torch.equal(env.reset()["observation"], first)
    assert time_limit("") is None
    with pytest.raises(ValueError, match="no environment that could be rendered"):
        make_env("", render_mode="rgb_array", **spaces).base_env.render()


def test_episodes_end_where_the_feed_says_so():
    """In some copies only; the others go on."""
    frames = torch.arange(8.0).view(4, 2, 1)
    ends = torch.tensor([[0, 0], [0, 1], [0, 0], [0, 0]], dtype=torch.bool).unsqueeze(-1)
    given = iter([0, 1, 1, 2])  # the second again, where an episode begins with it

    def feed(begins):
        step = next(given)
        return {"observation": frames[step], "truncated": ends[step], "reward": frames[step]}

    env = GivenTask({"observation": Unbounded(1)}, Unbounded(1), feed, 2)
    tensordict = env.reset()
    assert not tensordict["done"].any()
    step, tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))
    assert step["next", "done"].flatten().tolist() == [False, True]
    assert step["next", "reward"].flatten().tolist() == [2, 3]
    assert tensordict["observation"].flatten().tolist() == [2, 3]
    _, tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))
    assert tensordict["observation"].flatten().tolist() == [4, 5]
