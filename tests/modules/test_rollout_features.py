"""Features of a rollout are those of the backbone itself, and each frame is encoded once."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.value import GAE

from tests.modules.frames import NETWORKS, CountedFrames, make
from tests.numerics import assert_near
from torchrl_tit import Backbone, HistoryNetwork, VanillaTIT
from torchrl_tit.envs import make_env
from torchrl_tit.modules import add_rollout_features, make_value
from torchrl_tit.networks import MLP, NatureCNN, TwoTrunks
from torchrl_tit.settings import LSTM, Flat, Inner, Outer

pytestmark = pytest.mark.numerics


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
def test_features_are_those_of_the_backbone(name, padding):
    backbone, network, shape = make(name)
    rollout, frames = make_rollout(shape, padding)
    plain, plain_next = network(rollout["history"]), network(rollout["next", "history"])
    counted = CountedFrames(network)
    assert add_rollout_features(rollout, backbone, chunk_size=50) is rollout
    assert counted.take() == frames
    assert_near(rollout["features"], plain)
    assert_near(rollout["next", "features"], plain_next)


@pytest.mark.parametrize("k", [1, 2, 3, 9, 16])
def test_histories_of_any_length(k):
    backbone, network, shape = make(steps=k)
    rollout, frames = make_rollout(shape, k=k, cuts=0.2)
    counted = CountedFrames(network)
    add_rollout_features(rollout, backbone)
    assert counted.take() == frames
    assert_near(rollout["features"], network(rollout["history"]))
    assert_near(rollout["next", "features"], network(rollout["next", "history"]))


def test_steps_that_do_not_follow_each_other():
    backbone, network, shape = make()
    rollout, _ = make_rollout(shape)
    rollout = rollout[:, torch.randperm(40)]
    plain, plain_next = network(rollout["history"]), network(rollout["next", "history"])
    add_rollout_features(rollout, backbone)
    assert_near(rollout["features"], plain)
    assert_near(rollout["next", "features"], plain_next)


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
            assert_near(part["agents", "features"], network(part["agents", "history"]))


@pytest.mark.parametrize("network_class", [MLP, NatureCNN])
def test_networks_without_a_frame_encoder(network_class):
    shape = (3,) if network_class is MLP else (36, 36)
    network = network_class(shape, 4)
    keys = ["policy", "value"] if network_class is MLP else ["features"]
    rollout, _ = make_rollout(shape, time=10)
    backbone = Backbone(network, out_keys=keys)
    if network_class is MLP:
        rollout = rollout.apply(lambda x: x / 255 if x.is_floating_point() else x)
    add_rollout_features(rollout, backbone)
    for part in (rollout, rollout["next"]):
        plain = backbone(part.select("history").clone())
        for key in keys:
            assert_near(part[key], plain[key])


def make_pixels_and_state(k=4):
    """A network of images and arrays."""
    torch.manual_seed(0)
    return HistoryNetwork(
        {"pixels": Inner(patch_size=4, embed_dim=16), "state": Inner(embed_dim=16)},
        Outer(num_blocks=1),
        observation_shape={"pixels": (8, 8), "state": (3,)},
        num_frames=k,
    ).eval()


def test_several_observations_and_two_trunks():
    rollout, count = make_rollout((8, 8))
    for part in (rollout, rollout["next"]):
        part["pixels"] = part["history"]
        part["state"] = part.pop("history")[..., 0, :3].to(torch.get_default_dtype())
    network = TwoTrunks(make_pixels_and_state(), make_pixels_and_state())
    for parameter in network.value.parameters():
        parameter.add_(0.1 * torch.randn_like(parameter))
    backbone = Backbone(network, ["pixels", "state"], ["policy", "value"])
    plain = rollout.clone()
    for part in (plain, plain["next"]):
        backbone(part)
    counted = [CountedFrames(trunk) for trunk in (network.policy, network.value)]
    add_rollout_features(rollout, backbone, chunk_size=50)
    for counter in counted:
        assert counter.take() == 2 * count
    for key in ("policy", "value"):
        assert_near(rollout[key], plain[key])
        assert_near(rollout["next", key], plain["next", key])
    assert not torch.allclose(rollout["policy"], rollout["value"])


def test_a_module_that_is_no_history_network():
    backbone = Backbone(torch.nn.Flatten(-2))
    rollout, _ = make_rollout((3,))
    add_rollout_features(rollout, backbone)
    assert torch.equal(rollout["features"], rollout["history"].flatten(-2))
    assert torch.equal(rollout["next", "features"], rollout["next", "history"].flatten(-2))


def test_a_network_with_a_state_is_refused():
    network = HistoryNetwork(Flat(), LSTM(), observation_shape=(3,))
    backbone = Backbone(network, out_keys=["features"])
    rollout, _ = make_rollout((3,), k=1)
    with pytest.raises(ValueError, match="call the backbone on the rollout instead"):
        add_rollout_features(rollout, backbone)


def test_advantages_of_a_real_rollout():
    backbone, _, _ = make_cartpole()
    critic = make_value(8)
    env = make_env("CartPole-v1", 3, num_frames=4, seed=0)
    rollout = env.rollout(60, break_when_any_done=False)
    assert rollout["next", "done"].any()
    plain = rollout.clone()
    for td in (plain, plain["next"]):
        critic(backbone(td))
    add_rollout_features(rollout, backbone)
    for td in (rollout, rollout["next"]):
        critic(td)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=None)
    assert_near(gae(rollout)["advantage"], gae(plain)["advantage"])


def make_cartpole():
    torch.manual_seed(0)
    network = VanillaTIT((4,), 4, embed_dim=16, num_blocks=1, features_dim=8)
    return Backbone(network), network, (4,)
