"""History writes the last K observations of each environment, and nothing else."""

import pytest
import torch
from torchrl.envs import Compose, GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.transforms.streams import StreamEnv, assert_histories
from torchrl_tit.transforms import History


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 5])
@pytest.mark.parametrize("num_envs", [1, 4])
def test_equals_the_plain_reference(num_envs, num_frames, padding):
    env = TransformedEnv(StreamEnv([num_envs]), History(num_frames, padding=padding))
    assert_histories(env, num_frames, padding)


@pytest.mark.parametrize("padding", ["same", "constant"])
def test_images_stay_uint8(padding):
    stream = StreamEnv([3], shape=(2, 4, 5), dtype=torch.uint8)
    env = TransformedEnv(stream, History(3, observation_ndim=3, padding=padding))
    assert_histories(env, 3, padding)
    assert env.observation_spec["history"].shape == (3, 3, 2, 4, 5)
    assert env.observation_spec["history"].dtype is torch.uint8
    assert env.reset()["history"].dtype is torch.uint8


@pytest.mark.parametrize("padding", ["same", "constant"])
def test_nested_keys(padding):
    history = History(
        3, in_keys=[("camera", "observation")], out_keys=[("camera", "past")], padding=padding
    )
    env = TransformedEnv(StreamEnv([3], group="camera"), history)
    check_env_specs(env)
    assert_histories(
        env, 3, padding, observation=("camera", "observation"), history=("camera", "past")
    )


def test_separate_environments_in_a_batch():
    env = TransformedEnv(SerialEnv(2, [lambda: StreamEnv(seed=1), lambda: StreamEnv(seed=2)]))
    env.append_transform(History(3))
    assert_histories(env, 3, "same")


def test_without_a_batch():
    env = TransformedEnv(StreamEnv([], shape=(2,)), History(3))
    check_env_specs(env)
    first = env.reset()
    assert torch.equal(first["history"], first["observation"].expand(3, 2))


def test_several_observations():
    history = History(2, in_keys=["observation", "episode_reward"], out_keys=["a", "b"])
    env = TransformedEnv(StreamEnv([2]), Compose(RewardSum(), history))
    rollout = env.rollout(5, break_when_any_done=False)
    assert rollout["a"].shape == (2, 5, 2, 3)
    assert rollout["b"].shape == (2, 5, 2, 1)
    assert torch.equal(rollout["b"][..., -1, :], rollout["episode_reward"])


@pytest.mark.parametrize("num_frames", [1, 4])
def test_specs_tell_the_truth(num_frames):
    env = TransformedEnv(GymEnv("CartPole-v1"), History(num_frames))
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (4,)
    assert env.observation_spec["history"].shape == (num_frames, 4)


def test_one_frame_is_stored_nowhere():
    history = History(1)
    assert len(history) == 1
    assert not list(history.buffers())


def test_takes_one_key_as_a_name():
    env = TransformedEnv(StreamEnv([2]), History(2, "observation", "past"))
    assert env.reset()["past"].shape == (2, 2, 3)


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"num_frames": 0}, ValueError, "num_frames must be at least 1, but is 0"),
        ({"num_frames": 2.0}, TypeError, "num_frames must be an integer, but is 2.0"),
        ({"num_frames": 2, "observation_ndim": -1}, ValueError, "observation_ndim .* -1"),
        ({"num_frames": 2, "padding": "zeros"}, ValueError, "'same', 'constant', but is 'zeros'"),
        ({"num_frames": 2, "in_keys": ["a", "b"]}, ValueError, r"in_keys=\['a', 'b'\]"),
        ({"num_frames": 2, "in_keys": [], "out_keys": []}, ValueError, "at least one"),
        ({"num_frames": 2, "out_keys": ["observation"]}, ValueError, "key of its own"),
    ],
)
def test_wrong_arguments(arguments, error, words):
    with pytest.raises(error, match=words):
        History(**arguments)


@pytest.mark.parametrize("wrap", [lambda history: history, lambda history: Compose(history)])
def test_wrong_environment(wrap):
    with pytest.raises(ValueError, match=r"shape \[2, 4, 5\], so observation_ndim must be 3"):
        TransformedEnv(StreamEnv([3], shape=(2, 4, 5)), wrap(History(2)))
    with pytest.raises(KeyError, match=r"'pixels' in the environment, which has \['observation'\]"):
        TransformedEnv(StreamEnv([3]), wrap(History(2, in_keys=["pixels"])))
