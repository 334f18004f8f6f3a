"""Velocities are hidden, and nothing else, whatever stands above or below."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_tit.envs import make_env
from torchrl_tit.transforms import VELOCITIES, HideEntries, HideVelocities

TASKS = {"CartPole": "v1", "Acrobot": "v1", "MountainCar": "v0", "Pendulum": "v1"} | dict.fromkeys(
    ["Hopper", "Walker2d", "HalfCheetah"], "v5"
)


def velocities(task):
    """What the simulation says they are."""
    if hasattr(task, "data"):
        return task.data.qvel.clip(-10, 10)  # the tasks clip some
    state = np.asarray(task.state)
    return {"CartPole": state[1::2], "Acrobot": state[2:]}.get(
        type(task).__name__.removesuffix("Env"), state[1:]
    )


@pytest.mark.parametrize("name", VELOCITIES)
def test_these_are_the_velocities(name):
    task = gymnasium.make(f"{name}-{TASKS[name]}").unwrapped
    task.reset(seed=0)
    task.action_space.seed(0)
    for _ in range(5):
        observation, *_ = task.step(task.action_space.sample())
        observed = observation[VELOCITIES[name]].clip(-10, 10)
        np.testing.assert_allclose(observed, velocities(task), rtol=1e-6)
        assert len(VELOCITIES[name]) == np.size(velocities(task))


@pytest.mark.parametrize(
    ("name", "left"), [("CartPole-v1", 2), ("Acrobot-v1", 4), ("Hopper-v5", 5)]
)
def test_history_and_observation_are_those_of_the_whole_task_less_the_velocities(name, left):
    whole, hidden = (
        make_env(name, 3, seed=0, num_frames=4, hide_velocities=hide, max_episode_steps=13)
        for hide in (False, True)
    )
    assert hidden.observation_spec["history"].shape == (3, 4, left)
    size = whole.observation_spec["observation"].shape[-1]
    seen = [i for i in range(size) if i not in VELOCITIES[name.split("-")[0]]]
    hidden.set_seed(0)
    root, expected = hidden.reset(), whole.reset()
    for _ in range(40):
        expected = whole.rand_action(expected)
        step, root = hidden.step_and_maybe_reset(root.set("action", expected["action"]))
        expected_step, expected = whole.step_and_maybe_reset(expected)
        for key in ("history", "observation"):
            assert torch.equal(step["next", key], expected_step["next", key][..., seen])
            assert torch.equal(root[key], expected[key][..., seen])
        assert torch.equal(step["next", "reward"], expected_step["next", "reward"])


def test_nested_keys_and_tensordicts():
    transform = HideEntries([0], in_keys=[("sensors", "joints")])
    joints = torch.randn(5, 7, 3)
    result = transform(TensorDict({"sensors": {"joints": joints}}, [5]))
    assert torch.equal(result["sensors", "joints"], joints[..., 1:])


def test_bad_input():
    with pytest.raises(
        ValueError, match=r"'Ant-v5' are velocities, only of CartPole, .*use HideEntries"
    ):
        HideVelocities("Ant-v5")
    with pytest.raises(ValueError, match=r"'Hopper-v5' has 11 entries, not 12; use HideEntries"):
        make_env(  # with one more entry at the front
            "Hopper-v5", hide_velocities=True, exclude_current_positions_from_observation=False
        )
    wrappers = ["gymnasium.wrappers:TimeAwareObservation(flatten=False)"]
    with pytest.raises(ValueError, match=r"with other names \(obs, time\): leave one of them out"):
        make_env("CartPole-v1", hide_velocities=True, wrappers=wrappers)
    with pytest.raises(ValueError, match=r"hidden is \[1, 1\]"):
        HideEntries([1, 1])
    for hidden in ([4], [0, 1, 2, 3]):
        env = TransformedEnv(GymEnv("CartPole-v1"), HideEntries(hidden))
        with pytest.raises(ValueError, match=r"entries 0 to 3.*cannot be hidden"):
            env.reset()
