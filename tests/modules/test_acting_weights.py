"""Which weights acting uses: those of now, if PyTorch counts the write, and of each collection."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.data import Unbounded

from tests.modules.frames import CountedFrames, assert_exact, encoder_of, features, make
from tests.numerics import assert_near
from torchrl_tit.envs import make_env
from torchrl_tit.modules import ActingCollector, make_actor

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


@torch.no_grad()
def change(network):
    """Changes all weights, without increasing their versions."""
    for parameter in network.parameters():
        parameter.data += 0.1


def load(module, assign=False):
    weights = {name: weight + 0.1 for name, weight in module.state_dict().items()}
    module.load_state_dict(weights, assign=assign)


def step(module):
    for parameter in module.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.Adam(module.parameters(), lr=0.1).step()


def more(weights):
    return weights.apply(lambda weight: weight.detach() + 0.1)


@pytest.mark.parametrize("clears", [True, False])
@torch.no_grad()
def test_writes_that_leave_no_trace(clears):
    """Without a call of mark_weight_update, older frames keep the tokens of the old weights."""
    backbone, network, shape = make()
    stream = torch.randn(5, 10, *shape)
    with backbone.acting():
        assert_exact(backbone, stream[:, :4])
        change(network)
        if clears:
            backbone.mark_weight_update()
        for start in range(1, 6):
            history = stream[:, start : start + 4]
            same = torch.allclose(features(backbone, history), network(history), atol=1e-9)
            assert same == (clears or start > 3)
        change(network)
    with backbone.acting():  # each context begins with the weights of then
        assert_exact(backbone, stream[:, 6:10])


@pytest.mark.parametrize(
    "change",
    [
        lambda backbone: load(nn.Sequential(backbone)),
        lambda backbone: load(encoder_of(backbone.module)),
        lambda backbone: load(encoder_of(backbone.module), assign=True),
        lambda backbone: step(encoder_of(backbone.module)),
        lambda backbone: more(TensorDict.from_module(backbone)).to_module(backbone),
        lambda backbone: nn.Sequential(backbone).half().double(),
    ],
    ids=["load", "load the frame encoder", "assign", "optimizer", "to_module", "cast"],
)
@torch.no_grad()
def test_writes_that_pytorch_counts(change):
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
    stream = torch.randn(5, 9, *shape)
    with backbone.acting(), mode():
        for start, weights in enumerate([first, more(first), more(first), first]):
            with weights.to_module(backbone):
                assert_exact(backbone, stream[:, start : start + 4])


class Count(nn.Module):
    """Counts the frames that are encoded at each step, and calls a function at one of them."""

    def __init__(self, network, at=-1, call=None):
        super().__init__()
        self.frames, self.steps, self.at, self.call = CountedFrames(network), 0, at, call

    def forward(self, features):
        self.steps += 1
        if self.steps == self.at:
            self.call()
        return features.new_full((len(features), 1), self.frames.take())


def make_policy(**options):
    """A policy for Pendulum, whose observations have three entries; it writes "encoded"."""
    backbone, network, _ = make()
    count = TensorDictModule(Count(network, **options), in_keys=["features"], out_keys=["encoded"])
    policy = TensorDictSequential(backbone, make_actor(8, Unbounded((1,))), count)
    return policy.float().eval(), network  # environments write float32


make_pendulum = partial(make_env, "Pendulum-v1", 2, seed=0, num_frames=4)
SETTINGS = {
    "frames_per_batch": 24,
    "total_frames": 96,
    "trust_policy": True,
    "auto_register_policy_transforms": False,
}


@pytest.mark.parametrize("processes", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_weights_sent_to_a_collector_are_used(processes):
    """Each batch has the features of the network before the update that follows it."""
    policy, network = make_policy()
    collector: BaseCollector
    if processes:
        collector = MultiSyncCollector(
            [make_pendulum], policy, collector_class=ActingCollector, **SETTINGS
        )
    else:
        collector = ActingCollector(make_pendulum(), policy, **SETTINGS)
    count = 0
    for batch in collector:
        assert policy[0]._acting is None
        with torch.no_grad():
            assert_near(batch["features"], network(batch["history"]))
        assert (batch["encoded"][..., 1:, :] == 2).all()  # both environments' newest frames
        change(network)
        collector.update_policy_weights_()
        count += 1
    assert count == 4
    collector.shutdown()


@torch.no_grad()
def test_weights_that_arrive_during_a_batch_are_used():
    def arrive():
        weights = TensorDict.from_module(policy).data
        collector.update_policy_weights_(weights.apply(lambda x: x + 0.1))

    policy, network = make_policy(at=6, call=arrive)
    collector = ActingCollector(make_pendulum(), policy, **SETTINGS)
    policy[-1].module.steps = 0
    batch = next(iter(collector))
    after = slice(6, None)
    assert_near(batch["features"][:, after], network(batch["history"][:, after]))
    assert (batch["encoded"][0].flatten()[7:] == 2).all()
    collector.shutdown()
