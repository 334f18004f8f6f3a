"""Acting mode notices every way in which a frame encoder's weights can change."""

import shutil
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictParams, TensorDictSequential
from torch import multiprocessing, nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Categorical, Unbounded
from torchrl.objectives import DQNLoss, SoftUpdate

from tests.modules.frames import CountedFrames, assert_exact, encoder_of, features, make
from tests.numerics import assert_near
from torchrl_tit.envs import make_env
from torchrl_tit.frames import FrameEncoder
from torchrl_tit.modules import acting, make_actor, while_acting

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def step_of(optimizer_class, compiled=False, **options):
    def change(network):
        parameters = list(network.parameters())
        optimizer = optimizer_class(parameters, lr=0.1, **options)
        for parameter in parameters:
            parameter.grad = torch.randn_like(parameter)
        step = torch.compile(optimizer.step) if compiled else optimizer.step
        step()

    return change


def write_into_data(network):
    encoder_of(network).class_token.data += 1


def write_one_bit_into_data(network):
    weight = encoder_of(network).blocks[1].ffn[2].bias.data
    weight[3] = torch.nextafter(weight[3], torch.tensor(9.0, dtype=weight.dtype))


def write_into_a_numpy_view(network):
    encoder_of(network).class_token.detach().numpy()[:] += 1


def set_data(network):
    token = encoder_of(network).class_token
    token.data = token.data + 1


def transpose_in_place(network):
    weight = encoder_of(network).blocks[0].attention.out_proj.weight
    weight.data = weight.data.t()  # the same memory, read in another order


def copy_into(network):
    with torch.no_grad():
        encoder_of(network).class_token.copy_(torch.ones(16))


def load_state_dict(network):
    network.load_state_dict({name: x + 0.1 for name, x in network.state_dict().items()})


def assign_state_dict(network):
    network.load_state_dict({n: x + 0.1 for n, x in network.state_dict().items()}, assign=True)


def update_tensordict_data(network):
    weights = TensorDict.from_module(network)
    weights.data.update_(weights.data.apply(lambda x: x + 0.1))


def update_tensordict_params(network):
    weights = TensorDictParams(TensorDict.from_module(network), no_convert=True)
    weights.data.copy_(weights.data.apply(lambda x: x + 0.1))


def write_from_another_process(network):
    network.share_memory()
    process = multiprocessing.get_context("fork").Process(
        target=write_into_data, args=(network,), daemon=True
    )
    process.start()
    process.join()
    assert process.exitcode == 0


def replace_parameter(network):
    encoder_of(network).class_token = nn.Parameter(torch.ones(1, 1, 16))


def replace_module(network):
    encoder_of(network).blocks[0] = encoder_of(make()[1]).blocks[1]


def add_parameter(network):
    block = encoder_of(network).blocks[0]
    nn.utils.parametrizations.weight_norm(block.ffn[0])
    block.ffn[0].parametrizations.weight.original0.data += 1


def write_into_buffer(network):
    encoder_of(network).norm.running_mean += 1


CHANGES = {
    "Adam": step_of(torch.optim.Adam, foreach=False),
    "fused Adam": step_of(torch.optim.Adam, fused=True),
    "foreach Adam": step_of(torch.optim.Adam, foreach=True),
    "fused SGD": step_of(torch.optim.SGD, fused=True),
    "RMSprop": step_of(torch.optim.RMSprop),
    ".data": write_into_data,
    ".data, one bit": write_one_bit_into_data,
    ".data =": set_data,
    ".data = .data.t()": transpose_in_place,
    "NumPy": write_into_a_numpy_view,
    "copy_": copy_into,
    "load_state_dict": load_state_dict,
    "load_state_dict(assign)": assign_state_dict,
    "TensorDict.data.update_": update_tensordict_data,
    "TensorDictParams.data.copy_": update_tensordict_params,
    "another process": write_from_another_process,
    "a new parameter": replace_parameter,
    "a new module": replace_module,
    "a parametrization": add_parameter,
    "initialisation": lambda network: nn.init.normal_(encoder_of(network).class_token),
    "double and back": lambda network: network.half().double(),
}


def assert_noticed(change, network, backbone, shape):
    """Acts, changes the weights and acts again: features are always those of the network."""
    frames = CountedFrames(network)
    stream = torch.randn(5, 8, *shape)
    with backbone.acting():
        for start in range(4):
            if start == 2:
                features_without_gradient(backbone, stream[:, 2:6])
                change(network)
            frames.take()
            acted = features_without_gradient(backbone, stream[:, start : start + 4])
            assert frames.take() == (20 if start in (0, 2) else 5)
            with torch.no_grad():
                assert_near(acted, network(stream[:, start : start + 4]))


@torch.no_grad()
def features_without_gradient(backbone, history):
    return features(backbone, history)


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changed_weights_are_noticed(change):
    backbone, network, shape = make()
    assert_noticed(change, network, backbone, shape)


def test_a_new_frame_encoder_is_noticed():
    backbone, network, shape = make()
    stream = torch.randn(5, 8, *shape)
    with backbone.acting(), torch.no_grad():
        assert_exact(backbone, stream[:, :4])
        network.frame_encoders["observation"] = encoder_of(make()[1])
        encoder_of(network).class_token += 1
        assert_exact(backbone, stream[:, 1:5])
        frames = CountedFrames(network)
        features(backbone, stream[:, 2:6])
        assert frames.take() == 5


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
def test_a_compiled_optimizer_is_noticed():
    backbone, network, shape = make()
    assert_noticed(step_of(torch.optim.Adam, compiled=True), network, backbone, shape)


def test_a_whole_update_in_a_compiled_graph_is_noticed():
    def update(network):
        @torch.compile(backend="aot_eager")
        def step():
            with torch.no_grad():
                for parameter in network.parameters():
                    parameter.mul_(1.1)

        step()

    backbone, network, shape = make()
    assert_noticed(update, network, backbone, shape)


def test_buffers_are_weights_too():
    backbone, network, shape = make("images")
    norm = nn.BatchNorm1d(2).eval()  # over [N, L = 2, D]

    class Normed(FrameEncoder):
        def __init__(self, encoder):
            super().__init__(
                encoder.observation_shape, num_tokens=encoder.num_tokens, width=encoder.width
            )
            self.encoder, self.norm = encoder, norm

        def forward(self, x):
            tokens = self.encoder(x)
            return self.norm(tokens.flatten(0, -3)).view(tokens.shape)

    network.frame_encoders["observation"] = Normed(encoder_of(network))
    assert_noticed(write_into_buffer, network, backbone, shape)


@pytest.mark.parametrize("part", ["history_encoder", "head"])
def test_nothing_after_the_frame_encoder_is_kept(part):
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 8, *shape)
    optimizer = torch.optim.Adam(network.get_submodule(part).parameters(), lr=0.1, fused=True)
    with backbone.acting():
        for start in range(4):
            frames.take()
            acted = features_without_gradient(backbone, stream[:, start : start + 4])
            assert frames.take() == (5 if start else 20)
            full = network(stream[:, start : start + 4])
            assert_near(acted, full)
            full.square().sum().backward()
            optimizer.step()


@torch.no_grad()
def test_weights_in_bfloat16():
    backbone, network, shape = make()
    network.bfloat16()
    frames = CountedFrames(network)
    stream = torch.randn(5, 8, *shape, dtype=torch.bfloat16)
    with backbone.acting():
        for start in range(4):
            if start == 2:
                encoder_of(network).class_token += 0.1
            frames.take()
            acted = features(backbone, stream[:, start : start + 4])
            assert frames.take() == (20 if start in (0, 2) else 5)
            full = network(stream[:, start : start + 4])
            torch.testing.assert_close(acted, full, rtol=0, atol=0.1)


@torch.no_grad()
def test_updates_at_every_step():
    backbone, network, shape = make()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01, fused=True)
    for parameter in network.parameters():
        parameter.grad = torch.randn_like(parameter)
    stream = torch.randn(5, 12, *shape)
    with backbone.acting():
        for start in range(8):
            history = stream[:, start : start + 4]
            assert_near(features(backbone, history), network(history))
            optimizer.step()


@pytest.mark.parametrize("preserve", [True, False])
@torch.no_grad()
def test_other_weights_that_are_swapped_in_and_out(preserve):
    """As losses do with target weights: as parameters, or as plain tensors in their places."""
    backbone, network, shape = make()
    own = TensorDict.from_module(network)
    others = [own.data.apply(lambda x, i=i: x + 0.1 * i) for i in (1, 2)]
    stream = torch.randn(5, 12, *shape)
    with backbone.acting():
        for start in range(8):
            history = stream[:, start : start + 4]
            weights = others[start % 3 - 1] if start % 3 else own
            with weights.to_module(network, preserve_module_state=preserve):
                acted, full = features(backbone, history), network(history)
            assert_near(acted, full)


def test_target_weights_of_a_loss_and_their_soft_update():
    backbone, network, shape = make()
    head = make_actor(8, Categorical(2)).module[0]
    head.out_keys = ["action_value"]
    value_network = TensorDictSequential(backbone, head)
    loss = DQNLoss(value_network, action_space="categorical", delay_value=True)
    updater = SoftUpdate(loss, tau=0.5)
    stream = torch.randn(5, 12, *shape)
    with backbone.acting(), torch.no_grad():
        for start in range(8):
            history = stream[:, start : start + 4]
            if start == 2:
                loss.value_network_params.data.apply_(lambda x: x.add_(0.1))
            if start % 3 == 2:
                updater.step()
            for weights in (loss.value_network_params, loss.target_value_network_params):
                with weights.to_module(value_network):
                    acted, full = features(backbone, history), network(history)
                    assert_near(acted, full)


def make_policy():
    """A policy for Pendulum, whose observations have three entries."""
    backbone, network, _ = make()
    action = Unbounded((1,))
    policy = TensorDictSequential(backbone, make_actor(8, action))
    return policy.float().eval(), network  # environments write float32


def assert_exact_batch(batch, network):
    with torch.no_grad():
        full = network(batch["history"])
    assert_near(batch["features"], full)


def test_weights_sent_to_a_collector_are_noticed():
    policy, network = make_policy()
    env = make_env("Pendulum-v1", 2, seed=0, num_frames=4)
    collector = Collector(env, policy, frames_per_batch=24, total_frames=96)
    frames = CountedFrames(network)
    weights = TensorDict.from_module(policy).data.clone()
    with acting(policy):  # over the updates too
        for batch in collector:
            assert frames.take() <= 2 * 12 + 2 * 3  # one frame a step, and the first history
            assert_exact_batch(batch, network)
            weights.apply_(lambda x: x.add_(0.05))
            collector.update_policy_weights_(weights)
            frames.take()
    collector.shutdown()


def test_a_policy_acts_only_while_a_batch_is_collected():
    policy, network = make_policy()
    env = make_env("Pendulum-v1", 2, seed=0, num_frames=4)
    collector = Collector(env, policy, frames_per_batch=24, total_frames=96)
    frames = CountedFrames(network)
    batches = 0
    for batch in while_acting(policy, collector):
        assert frames.take() <= 2 * 12 + 2 * 3
        assert policy[0]._acting is None
        assert_exact_batch(batch, network)
        frames.take()
        batches += 1
    assert batches == 4
    collector.shutdown()


@pytest.mark.slow
def test_weights_sent_to_another_process_are_noticed():
    policy, network = make_policy()
    with acting(policy):  # so that the worker's copy acts
        collector = MultiSyncCollector(
            [partial(make_env, "Pendulum-v1", 2, seed=0, num_frames=4)],
            policy,
            frames_per_batch=24,
            total_frames=72,
        )
    batches = 0
    for batch in collector:
        assert_exact_batch(batch, network)
        for parameter in network.parameters():
            parameter.data.add_(0.05)
        collector.update_policy_weights_()
        batches += 1
    assert batches == 3
    collector.shutdown()
