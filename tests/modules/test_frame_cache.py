"""Acting mode gives the features of the full pass, whatever the input."""

import copy
import io
import pickle
import random

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.modules.frames import (
    NETWORKS,
    SMALL,
    CountedFrames,
    Streams,
    assert_exact,
    cache_of,
    encoder_of,
    features,
    make,
)
from tests.numerics import assert_near
from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.modules import FrameCache, acting
from torchrl_tit.modules.acting import clear_caches
from torchrl_tit.networks import MLP, NatureCNN, TwoTrunks

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


@pytest.fixture(autouse=True)
def without_gradients():
    with torch.no_grad():
        yield


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("name", NETWORKS)
def test_features_are_those_of_the_full_pass_whatever_comes(name, padding):
    backbone, network, shape = make(name)
    random.seed(0)
    dtype = torch.uint8 if len(shape) > 1 else None
    streams = Streams(5, 4, shape, padding, dtype)
    evaluation = Streams(3, 4, shape, padding, dtype)
    with backbone.acting():
        for _ in range(60):
            match random.randrange(8):
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
                    backbone.clear_cache()
                case _:
                    pass
            assert_exact(backbone, streams.step(torch.rand(5) < 0.2))


def test_a_wrong_token_would_show():
    backbone, network, shape = make()
    streams = Streams(5, 4, shape)
    with backbone.acting():
        features(backbone, streams.windows)
        history = streams.step(torch.zeros(5, dtype=torch.bool))
        cache_of(backbone).tokens.entries[0, 1] *= -1
        assert not torch.allclose(features(backbone, history), network(history), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["enhanced", "images"])
def test_only_new_frames_are_encoded(name):
    backbone, network, shape = make(name, steps=6)
    frames = CountedFrames(network)
    dtype = torch.uint8 if len(shape) > 1 else None
    nobody, one = torch.zeros(4, dtype=torch.bool), torch.tensor([False, True, False, False])

    streams = Streams(4, 6, shape, "same", dtype)
    with backbone.acting():
        features(backbone, streams.windows)
        assert frames.take() == 4  # the first history of an episode is one frame six times
        for reset in (nobody, nobody, one, nobody, ~nobody, nobody):
            features(backbone, streams.step(reset))
            assert frames.take() == 4
        features(backbone, torch.randn(4, 6, *shape).to(streams.dtype))
        assert frames.take() == 24

    streams = Streams(4, 6, shape, "constant", dtype)
    with backbone.acting():
        features(backbone, streams.windows)
        assert frames.take() == 5  # and the zeros before it
        features(backbone, streams.step(nobody))
        assert frames.take() == 4
        features(backbone, streams.step(one))
        assert frames.take() == 5
        changed = streams.step(nobody).clone()
        changed[2, 1] += 1
        features(backbone, changed)
        assert frames.take() == 5

    features(backbone, streams.windows)
    assert frames.take() == 24  # out of acting mode


def test_leading_shapes():
    backbone, network, shape = make()
    frames = CountedFrames(network)
    for leading in [(), (1,), (2, 3), (0,), (2, 0)]:
        stream = torch.randn(*leading, 7, *shape)
        numel = torch.Size(leading).numel()
        with backbone.acting():
            for start in range(4):
                history = stream[..., start : start + 4, :]
                td = backbone(TensorDict({"history": history}, leading))
                assert frames.take() == numel * (4 if start == 0 else 1)
                assert_near(td["features"], network(history))
                frames.take()


def test_another_leading_shape_of_the_same_frames():
    backbone, _, shape = make()
    stream = torch.randn(6, 5, *shape)
    with backbone.acting():
        assert_exact(backbone, stream[:, :4])
        assert_exact(backbone, stream[:, 1:].unflatten(0, (2, 3)))
        assert_exact(backbone, stream[:4, 1:])


def test_nested_keys():
    _, network, shape = make()
    backbone = Backbone(network, [("agent", "history")], [("agent", "features")])
    frames = CountedFrames(network)
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        for start in range(3):
            history = stream[:, start : start + 4]
            td = backbone(TensorDict({"agent": {"history": history}}, [5]))
            assert frames.take() == (20 if start == 0 else 5)
            assert_near(td["agent", "features"], network(history))
            frames.take()


@pytest.mark.parametrize(
    ("make_network", "shape"),
    [
        (lambda: EnhancedTIT((3,), 1, **SMALL), (1, 3)),
        (lambda: EnhancedTIT((3,), 4, outer=False, **SMALL), (4, 3)),
        (lambda: MLP((3,), 4), (4, 3)),
        (lambda: NatureCNN((36, 36), 4), (4, 36, 36)),
        (lambda: nn.Flatten(-2), (4, 3)),
    ],
    ids=["K=1", "without outer", "MLP", "NatureCNN", "other module"],
)
def test_networks_with_nothing_to_keep_pass_through(make_network, shape):
    network = make_network()
    names = ["policy", "value"] if isinstance(network, TwoTrunks) else ["features"]
    backbone = Backbone(network, out_keys=names)
    history = torch.rand(5, *shape)
    expected = backbone(TensorDict({"history": history}, [5]))
    with backbone.acting():
        assert backbone._acting is None
        td = backbone(TensorDict({"history": history}, [5]))
    assert all(torch.equal(td[name], expected[name]) for name in names)


@pytest.mark.parametrize("value", [float("nan"), -0.0, float("inf")])
def test_frames_are_the_same_if_their_bytes_are(value):
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.zeros(2, 6, *shape).uniform_()
    stream[0, 2] = value
    with backbone.acting():
        for start in range(3):
            assert_exact(backbone, stream[:, start : start + 4])
        frames.take()
        changed = stream[:, 2:6].clone()
        changed[0, 0] = 0.0
        features(backbone, changed)
        assert frames.take() > 2


class WithDoubles(nn.Module):
    def __init__(self, encoder):
        super().__init__()
        self.encoder = encoder

    def forward(self, x):
        return self.encoder(x.double())


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 7, 8])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_one_changed_byte_is_seen_at_any_size_and_offset(size, dtype):
    encoder = nn.Linear(size, 4)
    cache = FrameCache(WithDoubles(encoder), observation_ndim=1)
    memory = torch.randint(0, 255, (1 + 3 * 5 * size,)).to(dtype)
    for offset in (0, 1):
        stream = memory[offset : offset + 3 * 5 * size].view(3, 5, size)
        cache(stream[:, :4])
        for index in range(size):
            changed = stream[:, 1:].clone()
            changed[1, 1, index] += 1
            expected = encoder(changed.double())
            assert_near(cache(changed), expected)
            cache(stream[:, :4])


def test_the_same_bytes_of_another_type_are_another_frame():
    encoder = nn.Linear(3, 4)
    cache = FrameCache(WithDoubles(encoder), observation_ndim=1)
    stream = torch.randint(128, 256, (2, 5, 3), dtype=torch.uint8)
    cache(stream[:, :4])
    negative = stream[:, 1:].view(torch.int8)
    assert_near(cache(negative), encoder(negative.double()))


def test_histories_that_are_written_in_place():
    backbone, _, shape = make()
    history = torch.randn(5, 4, *shape)
    with backbone.acting():
        for _ in range(4):
            assert_exact(backbone, history)
            history[:, :-1] = history[:, 1:].clone()
            history[:, 0] += 1  # a frame that is new
            history[:, -1] = torch.randn(5, *shape)


def test_histories_of_any_memory_layout():
    backbone, _, shape = make()
    stream = torch.randn(*shape, 5, 9).permute(1, 2, 0)
    with backbone.acting():
        for start in range(5):
            assert_exact(backbone, stream[:, start : start + 4])


def test_only_one_batch_is_kept_and_it_goes_at_the_end():
    backbone, _, shape = make()
    with backbone.acting():
        for n in (7, 3):
            features(backbone, torch.randn(n, 4, *shape))
        kept = cache_of(backbone)
        kept_frames, tokens = kept.frames.entries, kept.tokens.entries
        assert tokens.shape == (3, 3, 2, 16)
        assert kept_frames.untyped_storage().nbytes() == 2 * (
            3 * 3 * 3 * 8
        )  # with room for as many
        assert tokens.untyped_storage().nbytes() == 2 * (3 * 3 * 2 * 16 * 8)
    assert backbone._acting is None


def test_acting_within_acting_leaves_what_the_outer_one_kept():
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        features(backbone, stream[:, :4])
        with backbone.acting():
            features(backbone, torch.randn(2, 4, *shape))
        frames.take()
        features(backbone, stream[:, 1:5])
        assert frames.take() == 5
        with pytest.raises(KeyError), backbone.acting():
            backbone(TensorDict({}, [5]))
        features(backbone, stream[:, 2:6])
        assert frames.take() == 5


def copies():
    def pickled(backbone):
        return pickle.loads(pickle.dumps(backbone))

    def saved(backbone):
        file = io.BytesIO()
        torch.save(backbone, file)
        file.seek(0)
        return torch.load(file, weights_only=False)

    return [copy.deepcopy, pickled, saved]


@pytest.mark.parametrize("copied", copies())
def test_copies_are_not_in_acting_mode(copied):
    backbone, network, shape = make()
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        features(backbone, stream[:, :4])
        twin = copied(backbone)
        assert twin._acting is None
        next(encoder_of(twin.module).parameters()).add_(1)
        assert_exact(twin, stream[:, 1:5])
        frames = CountedFrames(network)
        features(backbone, stream[:, 1:5])
        assert frames.take() == 5
    with twin.acting():
        assert_exact(twin, stream[:, :4])


def test_a_state_dict_is_the_networks():
    backbone, network, _ = make()
    with backbone.acting():
        assert list(backbone.state_dict()) == [f"module.{name}" for name in network.state_dict()]


@pytest.mark.parametrize(
    "clear",
    [
        Backbone.clear_cache,
        clear_caches,
        Backbone.state_dict,
        lambda backbone: nn.Sequential(backbone).state_dict(),
        lambda backbone: nn.Sequential(backbone).to(torch.float64),
    ],
    ids=["clear_cache", "clear_caches", "state_dict", "state_dict around it", "to"],
)
def test_the_cache_is_emptied(clear):
    backbone, network, shape = make()
    frames = CountedFrames(network)
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        features(backbone, stream[:, :4])
        clear(backbone)
        frames.take()
        features(backbone, stream[:, 1:5])
        assert frames.take() == 20


def test_a_run_that_continues_gives_the_bits_of_one_that_is_resumed():
    backbone, _, shape = make(steps=16)
    stream = torch.randn(5, 40, *shape)

    def act(backbone, start, stop):
        return [features(backbone, stream[:, i : i + 16]) for i in range(start, stop)]

    with backbone.acting():
        act(backbone, 0, 8)
        state = backbone.state_dict()
        continued = act(backbone, 8, 16)
    resumed = make(steps=16)[0]
    resumed.load_state_dict(state)
    with resumed.acting():
        assert all(map(torch.equal, continued, act(resumed, 8, 16)))


def test_acting_finds_every_backbone_of_a_policy():
    first, second = make()[0], make("vanilla")[0]
    policy = nn.ModuleList([first, nn.Sequential(second), nn.Linear(1, 1)])
    with acting(policy):
        assert first._acting is not None
        assert second._acting is not None
    assert first._acting is second._acting is None
    with acting(lambda td: td):
        pass
