"""Acting mode gives the features of the full pass, whatever comes, and encodes only new frames."""

import copy
import pickle
import random

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.modules.frames import (
    NETWORKS,
    CountedFrames,
    Streams,
    assert_exact,
    cache_of,
    encoder_of,
    features,
    make,
)
from tests.numerics import ROUNDING, assert_near
from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.modules import FrameCache, acting

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


@pytest.fixture(autouse=True)
def without_gradients():
    with torch.no_grad():
        yield


def fill(backbone, stream, steps=2):
    """Fills the cache and returns the next history, of which all frames but one are cached."""
    for start in range(steps):
        features(backbone, stream[:, start : start + 4])
    return stream[:, steps : steps + 4]


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("name", NETWORKS)
def test_features_are_those_of_the_full_pass_whatever_comes(name, padding):
    backbone, network, shape = make(name)
    random.seed(0)
    dtype = torch.uint8 if len(shape) > 1 else None
    streams = Streams(5, 4, shape, padding, dtype)
    evaluation = Streams(3, 4, shape, padding, dtype)
    with backbone.acting():
        for _ in range(30):
            match random.randrange(10):
                case 0:  # evaluation in between
                    assert_exact(backbone, evaluation.step(torch.rand(3) < 0.2))
                case 1:  # the environments in another order
                    streams.windows = streams.windows[torch.randperm(5)]
                case 2:  # the same input again
                    assert_exact(backbone, streams.windows)
                case 3:  # other observations in the middle of the history
                    streams.windows[1, 2] = streams.windows[0, 3]
                case 4:
                    next(encoder_of(network).parameters()).mul_(1.01)
                    backbone.reset_cache()
                case 5:  # written in place
                    streams.windows[2, :-1] = streams.windows[2, 1:].clone()
                    assert_exact(backbone, streams.windows)
                case 6:  # other leading dimensions, and another memory layout
                    td = TensorDict({"history": streams.windows.unsqueeze(1)}, [5, 1])
                    assert_near(backbone(td)["features"][:, 0], network(streams.windows))
                    assert_exact(
                        backbone, streams.windows.transpose(0, 1).contiguous().transpose(0, 1)
                    )
                case _:
                    pass
            assert_exact(backbone, streams.step(torch.rand(5) < 0.2))


@pytest.mark.parametrize("name", ["enhanced", "images"])
def test_only_new_frames_are_encoded(name):
    backbone, network, shape = make(name, steps=6)
    frames = CountedFrames(network)
    dtype = torch.uint8 if len(shape) > 1 else None
    nobody, one = torch.zeros(4, dtype=torch.bool), torch.tensor([False, True, False, False])
    # The first history of an episode is one frame six times, or that frame after zeros.
    for padding, first in (("same", 4), ("constant", 5)):
        streams = Streams(4, 6, shape, padding, dtype)
        with backbone.acting():
            features(backbone, streams.windows)
            assert frames.take() == first
            for reset in (nobody, one, nobody, ~nobody, nobody):
                features(backbone, streams.step(reset))
                assert frames.take() == (first if reset.any() else 4)
            changed = streams.step(nobody).clone()
            changed[2, 1] += 1
            features(backbone, changed)
            assert frames.take() == 5
    features(backbone, streams.windows)
    assert frames.take() == 24  # out of acting mode


@pytest.mark.parametrize("leading", [(), (1,), (2, 3), (0,), (2, 0)])
def test_leading_shapes_and_nested_keys(leading):
    _, network, shape = make()
    backbone = Backbone(network, [("agent", "history")], [("agent", "features")])
    frames, numel = CountedFrames(network), torch.Size(leading).numel()
    stream = torch.randn(*leading, 7, *shape)
    with backbone.acting():
        for start in range(4):
            history = stream[..., start : start + 4, :]
            td = backbone(TensorDict({"agent": {"history": history}}, leading))
            assert frames.take() == numel * (4 if start == 0 else 1)
            assert_near(td["agent", "features"], network(history))
            frames.take()


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 7, 8])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_one_changed_byte_is_seen_at_any_size_and_offset(size, dtype):
    encoder = nn.Sequential(Doubles(), nn.Linear(size, 4))
    cache = FrameCache(encoder, observation_ndim=1)
    memory = torch.randint(0, 255, (1 + 3 * 5 * size,)).to(dtype)
    for offset in (0, 1):
        stream = memory[offset : offset + 3 * 5 * size].view(3, 5, size)
        for index in range(size):
            cache(stream[:, :4])
            changed = stream[:, 1:].clone()
            changed[1, 1, index] += 1
            assert_near(cache(changed), encoder(changed))
    cache(stream[:, :4])
    others = stream[:, 1:].view(torch.int8 if dtype is torch.uint8 else torch.int32)
    assert_near(cache(others), encoder(others))  # the same bytes of another type


class Doubles(nn.Module):
    def forward(self, x):
        return x.double()


def test_frames_that_are_not_numbers_are_encoded():
    backbone, _, shape = make()
    stream = torch.rand(2, 6, *shape)
    stream[0, 2] = torch.nan
    with backbone.acting():
        for start in range(3):
            assert_exact(backbone, stream[:, start : start + 4])


def test_acting_within_acting_leaves_what_the_outer_one_kept():
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 6, *shape)
    with acting(nn.ModuleList([nn.Sequential(backbone), nn.Linear(1, 1)])), acting(print):
        features(backbone, stream[:, :4])
        with backbone.acting():
            features(backbone, torch.randn(2, 4, *shape))
        with pytest.raises(KeyError), backbone.acting():
            backbone(TensorDict({}, [5]))
        frames.take()
        features(backbone, stream[:, 1:5])
        assert frames.take() == 5
    assert backbone._acting is None


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_are_not_in_acting_mode(copied):
    backbone, _, shape = make()
    backbone.compile_parts(backend="eager")
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        features(backbone, stream[:, :4])
        twin = copied(backbone)
        assert twin._acting is twin._compiled is None
        next(encoder_of(twin.module).parameters()).add_(1)
        assert_exact(twin, stream[:, 1:5])
    with twin.acting():
        assert_exact(twin, stream[:, :4])


@pytest.mark.parametrize(
    "clear",
    [
        Backbone.reset_cache,
        Backbone.mark_weight_update,
        lambda backbone: nn.Sequential(backbone).state_dict(),
        lambda backbone: nn.Sequential(backbone).to(torch.float64),
    ],
    ids=["reset_cache", "mark_weight_update", "state_dict", "to"],
)
def test_the_cache_is_emptied(clear):
    """A run then continues with the bits of one that is resumed from its state dict."""
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 6, *shape)
    assert list(backbone.state_dict()) == [f"module.{name}" for name in network.state_dict()]
    with backbone.acting():
        features(backbone, stream[:, :4])
        clear(backbone)
        frames.take()
        continued = features(backbone, stream[:, 1:5])
        assert frames.take() == 20
    resumed = make()[0]
    with resumed.acting():
        assert torch.equal(features(resumed, stream[:, 1:5]), continued)


def test_gradients_are_whole_while_acting():
    backbone, network, shape = make()
    frames = CountedFrames(network)
    with backbone.acting():
        history = fill(backbone, torch.randn(5, 8, *shape)).clone()
        with torch.enable_grad():
            gradients = []
            for read in (lambda x: features(backbone, x), network):
                history = history.detach().requires_grad_()
                frames.take()
                read(history).square().sum().backward()
                assert frames.take() == 20
                gradients.append([history.grad, *(p.grad for p in network.parameters())])
                network.zero_grad()
        assert gradients[0][0][:, 0].any()
        assert_near(*gradients)
        features(backbone, history.detach())  # what was kept before is still valid
        assert frames.take() == 5


def test_tokens_of_inference_mode_are_used_in_inference_mode_only():
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 8, *shape)
    with backbone.acting():
        with torch.inference_mode():
            fill(backbone, stream)
            assert frames.take() == 20 + 5
        for start in (2, 3):  # tokens of inference mode cannot be written
            assert_exact(backbone, stream[:, start : start + 4])
            assert not cache_of(backbone).tokens.is_inference()


def test_active_dropout_draws_for_every_frame():
    network = EnhancedTIT((3,), 4, embed_dim=16, ffn_dropout_inner=0.5, attention_dropout_outer=0.5)
    backbone, frames = Backbone(network.train()), CountedFrames(network)
    (dropout, *_) = (m for m in encoder_of(network).modules() if getattr(m, "p", 0) > 0)
    with backbone.acting():
        history = fill(backbone, torch.randn(5, 8, 3))
        torch.manual_seed(1)
        acted = features(backbone, history)
        torch.manual_seed(1)
        assert torch.equal(acted, network(history))
        network.eval()
        for training, count in ((True, 20), (False, 20), (False, 5)):
            dropout.train(training)
            history = torch.cat([history[:, 1:], history[:, :1]], 1)
            frames.take()
            features(backbone, history)
            assert frames.take() == count


def test_dropout_within_attention_draws_for_every_frame():
    """`nn.MultiheadAttention` and recurrent layers have dropout without a module for it."""
    for dropout, count in ((0.5, 20), (0.0, 5)):
        layer = nn.MultiheadAttention(4, 1, dropout=dropout, batch_first=True)
        seen: list[int] = []

        class Encoder(nn.Module):
            def __init__(self, layer=layer):
                super().__init__()
                self.layer = layer

            def forward(self, frames, seen=seen):
                seen.append(frames[..., 0].numel())
                tokens = frames.reshape(-1, 1, 4)
                return self.layer(tokens, tokens, tokens)[0].reshape(*frames.shape[:-1], 1, 4)

        cache, frames = FrameCache(Encoder(), observation_ndim=1), torch.randn(5, 5, 4)
        with torch.no_grad():
            cache(frames[:, :-1])
            seen.clear()
            cache(frames[:, 1:])
        assert sum(seen) == count


def test_vmap_over_histories_and_over_weights():
    backbone, network, shape = make()
    with backbone.acting():
        history = fill(backbone, torch.randn(5, 8, *shape))

        def read(history, batch_size=()):
            return backbone(TensorDict({"history": history}, batch_size))["features"]

        def read_with(weights):
            with weights.to_module(backbone):
                return read(history, [5])

        assert_near(torch.vmap(read)(history), network(history))
        weights = TensorDict.from_module(backbone).data
        other = copy.deepcopy(backbone)
        for parameter in other.parameters():
            parameter.add_(0.1)
        stacked = TensorDict.stack([weights, TensorDict.from_module(other).data])
        expected = [network(history), other.module(history)]
        assert_near(list(torch.vmap(read_with)(stacked)), expected)
        assert_exact(backbone, history)


@pytest.mark.parametrize("record", ["export", "strict export", "compile", "jit"])
@pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning", "ignore::DeprecationWarning")
def test_a_recorded_backbone_is_the_whole_network(record):
    backbone, network, shape = make()
    network.requires_grad_(False)
    stream = torch.randn(5, 8, *shape)
    with backbone.acting():
        args = (fill(backbone, stream),)
        if record == "compile":
            recorded = torch.compile(backbone, backend="eager", fullgraph=True)
        elif record == "jit":
            recorded = torch.jit.trace(lambda history: backbone(history), args, check_trace=False)
        else:
            strict = record == "strict export"
            recorded = torch.export.export(backbone, args, strict=strict).module()
        kept = cache_of(backbone)
        for start in range(3):
            history = stream[:, start : start + 4]
            assert_near(recorded(history), network(history))
        assert cache_of(backbone) is kept


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
def test_compiled_parts(name):
    backbone, network, shape = make(name)
    graphs = []

    def backend(graph, inputs):
        graphs.append([x.shape for x in inputs if isinstance(x, torch.Tensor)])
        return graph

    backbone.compile_parts(backend=backend, dynamic=False, fullgraph=True)
    stream = torch.randn(5, 20, *shape)
    with backbone.acting():
        for start in range(6):
            if start == 3:
                encoder_of(network).requires_grad_()
                next(encoder_of(network).parameters()).mul_(1.1)
                backbone.reset_cache()
            if start == 4:
                stream[2, :] = torch.randn_like(stream[2])
            assert_exact(backbone, stream[:, start : start + 4])
    assert len(graphs) == 2  # the frame encoder, and all that follows it
    assert_exact(backbone, stream[:, :4])


def test_wrong_histories_are_refused():
    backbone, _, shape = make()
    with backbone.acting():
        fill(backbone, torch.randn(5, 8, *shape))
        with pytest.raises(ValueError, match="does not fit this network"):
            features(backbone, torch.randn(5, 3, *shape))
        with pytest.raises(TypeError, match="float32"):
            features(backbone, torch.randn(5, 4, *shape, dtype=torch.float32))
