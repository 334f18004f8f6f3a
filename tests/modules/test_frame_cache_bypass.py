"""Nothing is reused with gradients, dropout, vmap or tracing; and parts can be compiled."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch._subclasses import FakeTensorMode
from torch.autograd import forward_ad
from torch.nn.attention import SDPBackend, sdpa_kernel

from tests.modules.frames import (
    CountedFrames,
    assert_exact,
    cache_of,
    encoder_of,
    features,
    make,
)
from tests.numerics import ROUNDING, assert_near
from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.modules import FrameCache

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def act(backbone, stream, steps=2):
    """Fills the cache and returns the next history, of which all frames but one are cached."""
    with torch.no_grad():
        for start in range(steps):
            features(backbone, stream[:, start : start + 4])
    return stream[:, steps : steps + 4]


def test_gradients_are_whole_while_acting():
    backbone, network, shape = make()
    frames = CountedFrames(network)
    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape)).clone().requires_grad_()
        frames.take()
        features(backbone, history).square().sum().backward()
        assert frames.take() == 20
        acted = [history.grad, *(p.grad for p in network.parameters())]
        history.grad = None
        network.zero_grad()
        network(history).square().sum().backward()
        full = [history.grad, *(p.grad for p in network.parameters())]
        torch.testing.assert_close(acted, full, rtol=0, atol=0)
        assert history.grad[:, 0].any()
        # What was kept before is still valid.
        frames.take()
        with torch.no_grad():
            features(backbone, history.detach())
        assert frames.take() == 5


def test_gradients_of_the_history_alone():
    backbone, network, shape = make()
    network.requires_grad_(False)
    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape)).clone().requires_grad_()
        features(backbone, history).sum().backward()
        assert history.grad[:, 0].any()


def test_tokens_of_inference_mode_are_used_in_inference_mode_only():
    backbone, _, shape = make()
    stream = torch.randn(5, 8, *shape)
    with backbone.acting():
        with torch.inference_mode():
            features(backbone, stream[:, :4])
        with torch.no_grad():  # tokens of inference mode cannot be written
            for start in (1, 2):
                assert_exact(backbone, stream[:, start : start + 4])
                assert not cache_of(backbone).tokens.entries.is_inference()


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_without_gradients_only_the_newest_frame_is_encoded(mode):
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 8, *shape)
    with backbone.acting(), mode():
        features(backbone, stream[:, :4])
        frames.take()
        features(backbone, stream[:, 1:5])
        assert frames.take() == 5


@torch.no_grad()
def test_active_dropout_draws_for_every_frame():
    network = EnhancedTIT((3,), 4, embed_dim=16, ffn_dropout_inner=0.5, attention_dropout_outer=0.5)
    backbone = Backbone(network)
    frames = CountedFrames(network)
    with backbone.acting():
        network.train()
        history = act(backbone, torch.randn(5, 8, 3))
        frames.take()
        torch.manual_seed(1)
        acted = features(backbone, history)
        assert frames.take() == 20
        torch.manual_seed(1)
        assert torch.equal(acted, network(history))
        frames.take()

        network.eval()
        assert_exact(backbone, history)
        frames.take()
        inner = encoder_of(network).modules()
        (dropout, *_) = (m for m in inner if isinstance(m, nn.Dropout) and m.p > 0)
        dropout.train()
        features(backbone, torch.cat([history[:, 1:], history[:, :1]], 1))
        assert frames.take() == 20


@torch.no_grad()
def test_training_mode_without_dropout_keeps():
    backbone, network, shape = make()
    network.train()
    frames = CountedFrames(network)
    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape))
        frames.take()
        features(backbone, history)
        assert frames.take() == 5


@torch.no_grad()
def test_vmap_over_histories_and_over_weights():
    backbone, network, shape = make()
    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape))

        def of(history):
            return backbone(TensorDict({"history": history}))["features"]

        assert_near(torch.vmap(of)(history), network(history))

        weights = TensorDict.from_module(backbone).data
        stacked = TensorDict.stack([weights, weights.apply(lambda x: x + 0.1)])

        def with_weights(weights):
            with weights.to_module(backbone):
                return of_batch(history)

        def of_batch(history):
            return backbone(TensorDict({"history": history}, [5]))["features"]

        both = torch.vmap(with_weights)(stacked)
        assert_near(both[0], network(history))
        stacked[1].to_module(network_holder := copy.deepcopy(backbone))
        assert_near(both[1], network_holder.module(history))
        assert_exact(backbone, history)


@torch.no_grad()
def test_forward_mode_derivatives():
    backbone, network, shape = make()
    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape))
        tangent = torch.randn_like(history)
        with sdpa_kernel(SDPBackend.MATH):  # the fused kernel has no forward derivative
            full = torch.func.jvp(network, (history,), (tangent,))[1]
            with forward_ad.dual_level():
                dual = forward_ad.make_dual(history, tangent)
                _, acted = forward_ad.unpack_dual(features(backbone, dual))
        assert_near(acted, full)


@pytest.mark.parametrize("strict", [False, True])
@torch.no_grad()
def test_export_holds_the_whole_network(strict):
    backbone, network, shape = make()

    class Features(nn.Module):
        def __init__(self):
            super().__init__()
            self.backbone = backbone

        def forward(self, history):
            return self.backbone(history)

    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape))
        exported = torch.export.export(Features(), (history,), strict=strict).module()
    other = torch.randn(5, 4, *shape)
    assert_near(exported(other), network(other))


@torch.no_grad()
def test_a_compiled_backbone_is_the_whole_network():
    backbone, network, shape = make()
    compiled = torch.compile(backbone, backend="aot_eager", fullgraph=True)
    stream = torch.randn(5, 8, *shape)
    with backbone.acting():
        for start in range(3):
            history = stream[:, start : start + 4]
            td = compiled(TensorDict({"history": history}, [5]))
            assert_near(td["features"], network(history))
            assert cache_of(backbone) is None


@torch.no_grad()
def test_a_cache_of_its_own_that_is_compiled_or_reads_fake_tensors():
    _, network, shape = make()
    cache = FrameCache(encoder_of(network), len(shape))
    window = torch.randn(5, 4, *shape)
    compiled = torch.compile(lambda x: cache(x), backend="aot_eager", fullgraph=True)
    assert_near(compiled(window), encoder_of(network)(window))
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        assert cache(mode.from_tensor(window)).shape == (5, 4, 2, 16)
    assert cache._kept is None


@torch.no_grad()
def test_traced_by_jit_and_shaped_without_values():
    backbone, network, shape = make()
    network.requires_grad_(False)
    with backbone.acting():
        history = act(backbone, torch.randn(5, 8, *shape))
        traced = torch.jit.trace(lambda history: backbone(history), (history,), check_trace=False)
        other = torch.randn(5, 4, *shape)
        assert_near(traced(other), network(other))
        network.to("meta")
        assert features(backbone, history.to("meta")).shape == (5, 8)


@torch.no_grad()
def test_autocast_and_float32_do_not_share_tokens():
    backbone, network, shape = make()
    network.float()
    stream = torch.randn(5, 9, *shape, dtype=torch.float32)
    with backbone.acting():
        for start, enabled in enumerate([False, True, True, False, False]):
            with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
                history = stream[:, start : start + 4]
                acted, full = features(backbone, history), network(history)
                assert acted.dtype == full.dtype
                tolerance = 0.05 if enabled else ROUNDING[torch.float32]
                torch.testing.assert_close(acted, full, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", ["enhanced", "Catformer"])
@torch.no_grad()
def test_compiled_parts(name):
    backbone, network, shape = make(name)
    graphs = []

    def backend(graph, inputs):
        graphs.append([x.shape for x in inputs if isinstance(x, torch.Tensor)])
        return torch._dynamo.lookup_backend("aot_eager")(graph, inputs)

    backbone.compile_parts(backend=backend, dynamic=False, fullgraph=True)
    stream = torch.randn(5, 20, *shape)
    with backbone.acting():
        for start in range(6):
            if start == 3:
                encoder_of(network).requires_grad_()
                next(encoder_of(network).parameters()).mul_(1.1)
                backbone.clear_cache()
            if start == 4:
                stream[2, :] = torch.randn_like(stream[2])
            assert_exact(backbone, stream[:, start : start + 4])
    assert len(graphs) == 2  # the frame encoder, and all that follows it
    assert_exact(backbone, stream[:, :4])
    for twin in (copy.deepcopy(backbone), pickle.loads(pickle.dumps(backbone))):
        next(encoder_of(twin.module).parameters()).mul_(1.1)
        with twin.acting():
            assert_exact(twin, stream[:, :4])
    assert len(graphs) == 2


def test_wrong_histories_are_refused():
    backbone, _, shape = make()
    with backbone.acting(), torch.no_grad():
        act(backbone, torch.randn(5, 8, *shape))
        with pytest.raises(ValueError, match="does not fit this network"):
            features(backbone, torch.randn(5, 3, *shape))
        with pytest.raises(TypeError, match="float32"):
            features(backbone, torch.randn(5, 4, *shape, dtype=torch.float32))
