"""Weights are constant within acting mode; new ones are used from the next collection on."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Unbounded

from tests.modules.frames import CountedFrames, assert_exact, encoder_of, features, make
from tests.numerics import assert_near
from torchrl_tit.envs import make_env
from torchrl_tit.modules import ActingCollector, make_actor, while_acting

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


@torch.no_grad()
def change(network):
    """Changes all weights, without increasing their versions."""
    for parameter in network.parameters():
        parameter.data += 0.1


def test_each_context_begins_with_the_weights_of_then():
    backbone, network, shape = make()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.1, fused=True)
    stream = torch.randn(5, 8, *shape)
    for start in range(3):
        with backbone.acting(), torch.no_grad():
            for step in (start, start + 1):
                assert_exact(backbone, stream[:, step : step + 4])
        network(stream[:, :4]).square().sum().backward()
        optimizer.step()


@pytest.mark.parametrize("clears", [True, False])
@torch.no_grad()
def test_weights_that_change_within_the_context(clears):
    """Without a call of clear_cache, older frames keep the tokens of the old weights."""
    backbone, network, shape = make()
    stream = torch.randn(5, 10, *shape)
    with backbone.acting():
        assert_exact(backbone, stream[:, :4])
        change(network)
        if clears:
            backbone.clear_cache()
        for start in range(1, 6):
            history = stream[:, start : start + 4]
            same = torch.allclose(features(backbone, history), network(history), atol=1e-9)
            assert same == (clears or start > 3)


def load(module, assign=False):
    weights = {name: weight + 0.1 for name, weight in module.state_dict().items()}
    module.load_state_dict(weights, assign=assign)


def step(module):
    for parameter in module.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.Adam(module.parameters(), lr=0.1).step()


def more(weights):
    return weights.apply(lambda weight: weight.detach() + 0.1)


@pytest.mark.parametrize(
    "change",
    [
        load,
        partial(load, assign=True),
        lambda backbone: load(nn.Sequential(backbone)),
        lambda backbone: load(backbone.module),
        lambda backbone: load(encoder_of(backbone.module)),
        lambda backbone: load(encoder_of(backbone.module), assign=True),
        lambda backbone: step(encoder_of(backbone.module)),
        lambda backbone: more(TensorDict.from_module(backbone)).to_module(backbone),
        lambda backbone: backbone.half().double(),
        lambda backbone: nn.Sequential(backbone).half().double(),
    ],
    ids=[
        "load",
        "assign",
        "load around it",
        "load the network",
        "load the frame encoder",
        "assign to the frame encoder",
        "optimizer",
        "to_module",
        "cast",
        "cast around it",
    ],
)
@torch.no_grad()
def test_loaded_and_cast_weights_are_used(change):
    backbone, _, shape = make()
    stream = torch.randn(5, 8, *shape)
    with backbone.acting():
        for start in range(4):
            if start == 2:
                before = encoder_of(backbone.module).class_token.clone()
                change(backbone)
                assert not torch.equal(encoder_of(backbone.module).class_token, before)
            assert_exact(backbone, stream[:, start : start + 4])


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_weights_that_to_module_swaps_are_used(mode):
    """The swapped weights are no parameters, which is how TorchRL's losses call a network."""
    backbone, _, shape = make()
    first = more(TensorDict.from_module(backbone))
    second = more(first)
    stream = torch.randn(5, 9, *shape)
    with backbone.acting(), mode():
        for start, weights in enumerate([first, second, second, first]):
            with weights.to_module(backbone):
                assert_exact(backbone, stream[:, start : start + 4])


@torch.inference_mode()
def test_weights_of_inference_mode_are_used():
    backbone, network, shape = make()
    stream = torch.randn(5, 9, *shape)
    with backbone.acting():
        for start in range(4):
            assert_exact(backbone, stream[:, start : start + 4])
            for parameter in network.parameters():
                parameter.add_(0.1)


@pytest.mark.parametrize("part", ["history_encoder", "head"])
def test_nothing_after_the_frame_encoder_is_kept(part):
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 8, *shape)
    optimizer = torch.optim.Adam(network.get_submodule(part).parameters(), lr=0.1, fused=True)
    with backbone.acting():
        for start in range(4):
            frames.take()
            with torch.no_grad():
                acted = features(backbone, stream[:, start : start + 4])
            assert frames.take() == (5 if start else 20)
            full = network(stream[:, start : start + 4])
            assert_near(acted, full)
            full.square().sum().backward()
            optimizer.step()


class Count(nn.Module):
    """Counts the frames that are encoded at each step."""

    def __init__(self, network):
        super().__init__()
        self.frames = CountedFrames(network)

    def forward(self, features):
        return features.new_full((len(features), 1), self.frames.take())


def make_policy():
    """A policy for Pendulum, whose observations have three entries; it writes "encoded"."""
    backbone, network, _ = make()
    count = TensorDictModule(Count(network), in_keys=["features"], out_keys=["encoded"])
    policy = TensorDictSequential(backbone, make_actor(8, Unbounded((1,))), count)
    return policy.float().eval(), network  # environments write float32


make_pendulum = partial(make_env, "Pendulum-v1", 2, seed=0, num_frames=4)
SETTINGS = {
    "frames_per_batch": 24,
    "total_frames": 96,
    "trust_policy": True,
    "auto_register_policy_transforms": False,
}


def collect(policy, network, batches, update):
    """Changes the weights after each batch, whose features are those of the network before."""
    count = 0
    for batch in batches:
        assert policy[0]._acting is None
        with torch.no_grad():
            assert_near(batch["features"], network(batch["history"]))
        assert (batch["encoded"][..., 1:, :] == 2).all()  # both environments' newest frames
        update()
        count += 1
    assert count == 4


@pytest.mark.parametrize("kind", ["while_acting", "ActingCollector"])
def test_weights_sent_to_a_collector_are_used(kind):
    policy, network = make_policy()
    acts = kind == "ActingCollector"
    collector = (ActingCollector if acts else Collector)(make_pendulum(), policy, **SETTINGS)
    weights = TensorDict.from_module(policy).data.clone()

    def update():
        weights.apply_(lambda x: x.add_(0.05))
        collector.update_policy_weights_(weights)

    batches = collector if acts else while_acting(policy, collector)
    collect(policy, network, batches, update)
    collector.shutdown()


@pytest.mark.slow
def test_weights_sent_to_another_process_are_used():
    policy, network = make_policy()
    collector = MultiSyncCollector(
        [make_pendulum], policy, collector_class=ActingCollector, **SETTINGS
    )

    def update():
        change(network)
        collector.update_policy_weights_()

    collect(policy, network, collector, update)
    collector.shutdown()


@torch.no_grad()
def test_weights_that_arrive_during_a_batch_are_used():
    policy, network = make_policy()
    steps = []

    class Arrive(nn.Module):
        def forward(self, features):
            steps.append(features)
            if len(steps) == 6:
                collector.update_policy_weights_(weights.apply(lambda x: x + 0.1))
            return features

    arrive = TensorDictModule(Arrive(), in_keys=["features"], out_keys=["features"])
    policy = TensorDictSequential(policy, arrive)
    weights = TensorDict.from_module(policy).data.clone()
    collector = ActingCollector(make_pendulum(), policy, **SETTINGS)
    steps.clear()
    batch = next(iter(collector))
    after = slice(6, None)
    assert_near(batch["features"][:, after], network(batch["history"][:, after]))
    assert (batch["encoded"][0].flatten()[7:] == 2).all()
    collector.shutdown()
