"""History writes the last K observations of each environment, and nothing else."""

import pytest
import torch
from torchrl.envs import Compose, DTypeCastTransform, ObservationNorm, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.transforms.streams import StreamEnv, assert_histories
from torchrl_tit.transforms import History


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 5])
@pytest.mark.parametrize("num_envs", [1, 4])
def test_equals_the_plain_reference(num_envs, num_frames, padding):
    env = TransformedEnv(StreamEnv([num_envs]), History(num_frames, padding=padding))
    assert_histories(env, num_frames, padding)


def test_without_a_batch():
    env = TransformedEnv(StreamEnv([], shape=(2,)), History(3))
    check_env_specs(env)
    first = env.reset()
    assert torch.equal(first["history"], first["observation"].expand(3, 2))


def test_a_transform_before_it_may_change_the_dtype():
    env = TransformedEnv(StreamEnv([3], dtype=torch.uint8), Compose(History(4)))
    env.insert_transform(0, DTypeCastTransform(torch.uint8, torch.float32, ["observation"]))
    env.insert_transform(1, ObservationNorm(0.5, 1 / 255, in_keys=["observation"]))
    assert_histories(env, 4, "same")


def test_a_new_environment_takes_the_state():
    env, other = (TransformedEnv(StreamEnv([3], seed=seed), History(4)) for seed in (0, 1))
    env.rollout(9, break_when_any_done=False)
    (saved,) = env.state_dict().values()
    assert saved.any()
    other.load_state_dict(env.state_dict())
    assert torch.equal(*[each.state_dict()["_cat_buffers_observation"] for each in (env, other)])


def test_keys_of_histories() -> None:
    assert History(2, in_keys=["pixels"]).out_keys == ["history"]
    assert History(2, in_keys=[("agents", "observation_1")]).out_keys == [("agents", "history_1")]
    several = ["observation", "pixels", ("arm", "left"), ("observation", "own_observation")]
    names = ["observation", "pixels", "arm/left", "own_observation"]
    assert History(2, in_keys=several).out_keys == [("history", name) for name in names]


@pytest.mark.parametrize("wrap", [lambda history: history, lambda history: Compose(history)])
def test_wrong_environment(wrap):
    with pytest.raises(KeyError, match=r"'pixels' in the environment, which has \['observation'\]"):
        TransformedEnv(StreamEnv([3]), wrap(History(2, in_keys=["pixels"])))
