"""Features of a rollout are those of the plain way, and each frame is encoded once."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.value import GAE

from tests.modules.frames import NETWORKS, CountedFrames, make
from torchrl_tit import Backbone
from torchrl_tit.envs import make_env
from torchrl_tit.modules import add_rollout_features, make_value
from torchrl_tit.networks import MLP, NatureCNN


@pytest.fixture(autouse=True)
def without_gradients():
    with torch.no_grad():
        yield


def make_rollout(shape, padding="same", n=3, time=40, k=4, cuts=0.1):
    """[n, time], with terminal observations that no later history holds."""
    dtype = torch.float32 if len(shape) == 1 else torch.uint8

    def new(count):
        return torch.randint(0, 256, (count, 1, *shape)).to(dtype)

    steps, frames = [], 0
    windows = None
    reset = torch.ones(n, dtype=torch.bool)
    for _ in range(time):
        first = new(n)
        past = first if padding == "same" else torch.zeros_like(first)
        fresh = torch.cat([past.expand(n, k - 1, *shape), first], 1)
        windows = fresh if windows is None else windows.clone()
        windows[reset] = fresh[reset]
        frames += int(reset.sum()) * (1 if padding == "same" else 2)
        following = torch.cat([windows[:, 1:], new(n)], 1)
        frames += n
        reset = torch.rand(n) < cuts
        done = TensorDict({"history": following, "done": reset.unsqueeze(1)}, [n])
        steps.append(TensorDict({"history": windows, "next": done}, [n]))
        windows = following
    return torch.stack(steps, 1), frames


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("name", NETWORKS)
def test_features_are_those_of_the_plain_way(name, padding):
    backbone, network, shape = make(name)
    rollout, frames = make_rollout(shape, padding)
    plain, plain_next = network(rollout["history"]), network(rollout["next", "history"])
    counted = CountedFrames(network)
    assert add_rollout_features(rollout, backbone, chunk_size=50) is rollout
    assert counted.take() == frames
    torch.testing.assert_close(rollout["features"], plain, rtol=0, atol=1e-5)
    torch.testing.assert_close(rollout["next", "features"], plain_next, rtol=0, atol=1e-5)


@pytest.mark.parametrize("k", [1, 2, 3, 9, 16])
def test_histories_of_any_length(k):
    backbone, network, shape = make(steps=k)
    rollout, frames = make_rollout(shape, k=k, cuts=0.2)
    counted = CountedFrames(network)
    add_rollout_features(rollout, backbone)
    assert counted.take() == frames
    torch.testing.assert_close(rollout["features"], network(rollout["history"]), rtol=0, atol=1e-5)
    torch.testing.assert_close(
        rollout["next", "features"], network(rollout["next", "history"]), rtol=0, atol=1e-5
    )


def test_steps_that_do_not_follow_each_other():
    backbone, network, shape = make()
    rollout, _ = make_rollout(shape)
    rollout = rollout[:, torch.randperm(40)]
    plain, plain_next = network(rollout["history"]), network(rollout["next", "history"])
    add_rollout_features(rollout, backbone)
    torch.testing.assert_close(rollout["features"], plain, rtol=0, atol=1e-5)
    torch.testing.assert_close(rollout["next", "features"], plain_next, rtol=0, atol=1e-5)


def test_batch_shapes_and_nested_keys_with_their_own_dimensions():
    _, network, shape = make()
    backbone = Backbone(network, [("agents", "history")], [("agents", "features")])
    rollout, _ = make_rollout(shape, n=6)
    windows, following = rollout["history"], rollout["next", "history"]  # [6, 40, 4, 3]
    one = TensorDict(
        {"agents": {"history": windows[0]}, "next": {"agents": {"history": following[0]}}}, [40]
    )
    windows = windows.unflatten(0, (2, 3)).transpose(1, 2)  # [2, 40, 3 agents, 4, 3]
    following = following.unflatten(0, (2, 3)).transpose(1, 2)
    many = TensorDict(
        {"agents": {"history": windows}, "next": {"agents": {"history": following}}}, [2, 40]
    )
    for td in (one, many):
        add_rollout_features(td, backbone)
        for part in (td, td["next"]):
            torch.testing.assert_close(
                part["agents", "features"], network(part["agents", "history"]), rtol=0, atol=1e-5
            )


@pytest.mark.parametrize("network_class", [MLP, NatureCNN])
def test_networks_without_a_frame_encoder(network_class):
    shape = (3,) if network_class is MLP else (36, 36)
    network = network_class(shape, 4)
    keys = ["policy", "value"] if network_class is MLP else ["features"]
    rollout, _ = make_rollout(shape, time=10)
    rollout["history"], rollout["next", "history"]
    backbone = Backbone(network, out_keys=keys)
    if network_class is MLP:
        rollout = rollout.apply(lambda x: x / 255 if x.is_floating_point() else x)
    add_rollout_features(rollout, backbone)
    for part in (rollout, rollout["next"]):
        plain = backbone(part.select("history").clone())
        for key in keys:
            torch.testing.assert_close(part[key], plain[key], rtol=0, atol=1e-5)


def test_advantages_of_a_real_rollout():
    backbone, _, _ = make_cartpole()
    critic = make_value(8)
    env = make_env("CartPole-v1", 3, history=4, seed=0)
    rollout = env.rollout(60, break_when_any_done=False)
    assert rollout["next", "done"].any()
    plain = rollout.clone()
    for td in (plain, plain["next"]):
        critic(backbone(td))
    add_rollout_features(rollout, backbone)
    for td in (rollout, rollout["next"]):
        critic(td)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=None)
    torch.testing.assert_close(
        gae(rollout)["advantage"], gae(plain)["advantage"], rtol=0, atol=1e-4
    )


def make_cartpole():
    from torchrl_tit import VanillaTIT

    torch.manual_seed(0)
    network = VanillaTIT((4,), 4, embed_dim=16, num_blocks=1, features_dim=8)
    return Backbone(network), network, (4,)
