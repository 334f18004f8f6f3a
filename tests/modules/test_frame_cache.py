"""The frame cache gives the features of the full encode, whatever it is handed."""

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
    features,
    make,
)
from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.modules import FrameCache, acting
from torchrl_tit.networks import MLP, NatureCNN


@pytest.fixture(autouse=True)
def without_gradients():
    with torch.no_grad():
        yield


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("name", NETWORKS)
def test_features_are_those_of_the_full_encode_whatever_comes(name, padding):
    backbone, network, shape = make(name)
    random.seed(0)
    dtype = torch.uint8 if len(shape) > 1 else torch.float32
    streams = Streams(5, 4, shape, padding, dtype)
    evaluation = Streams(3, 4, shape, padding, dtype)
    with backbone.acting():
        for _ in range(60):
            match random.randrange(8):
                case 0:  # evaluation in between
                    assert_exact(backbone, evaluation.step(torch.rand(3) < 0.2))
                case 1:  # environments in another order
                    streams.windows = streams.windows[torch.randperm(5)]
                case 2:  # the same once more
                    assert_exact(backbone, streams.windows)
                case 3:  # other observations in the middle of the history
                    streams.windows[1, 2] = streams.windows[0, 3]
                case 4:
                    next(iter(network.frame_encoder.parameters())).mul_(1.01)
                case _:
                    pass
            assert_exact(backbone, streams.step(torch.rand(5) < 0.2))


def test_a_wrong_token_would_show():
    backbone, network, shape = make()
    streams = Streams(5, 4, shape)
    with backbone.acting():
        features(backbone, streams.windows)
        history = streams.step(torch.zeros(5, dtype=torch.bool))
        backbone._cache._kept.tokens.entries[0, 1] *= -1
        assert not torch.allclose(features(backbone, history), network(history), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["enhanced", "images"])
def test_only_new_frames_are_encoded(name):
    backbone, network, shape = make(name, steps=6)
    frames = CountedFrames(network)
    dtype = torch.uint8 if len(shape) > 1 else torch.float32
    nobody, one = torch.zeros(4, dtype=torch.bool), torch.tensor([False, True, False, False])

    streams = Streams(4, 6, shape, "same", dtype)
    with backbone.acting():
        features(backbone, streams.windows)
        assert frames.take() == 4  # an episode's first history is one frame six times
        for reset in (nobody, nobody, one, nobody, ~nobody, nobody):
            features(backbone, streams.step(reset))
            assert frames.take() == 4
        features(backbone, torch.randn(4, 6, *shape).to(dtype))
        assert frames.take() == 24

    streams = Streams(4, 6, shape, "constant", dtype)
    with backbone.acting():
        features(backbone, streams.windows)
        assert frames.take() == 8  # and the zeros before it
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
                torch.testing.assert_close(td["features"], network(history), rtol=0, atol=1e-5)
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
            torch.testing.assert_close(td["agent", "features"], network(history), rtol=0, atol=1e-5)
            frames.take()


@pytest.mark.parametrize(
    "network",
    [
        EnhancedTIT((3,), 1, **SMALL),
        EnhancedTIT((3,), 4, outer=False, **SMALL),
        MLP((3,), 4),
        NatureCNN((36, 36), 4),
        nn.Flatten(-2),
    ],
    ids=["K=1", "without outer", "MLP", "NatureCNN", "another's"],
)
def test_networks_with_nothing_to_keep_pass_through(network):
    shape, steps = getattr(network, "observation_shape", (3,)), getattr(network, "history", 4)
    names = ["policy", "value"] if isinstance(network, MLP) else ["features"]
    backbone = Backbone(network, out_keys=names)
    history = torch.rand(5, steps, *shape)
    expected = backbone(TensorDict({"history": history}, [5]))
    with backbone.acting():
        assert backbone._cache is None
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


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 7, 8])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_one_changed_byte_is_seen_at_any_size_and_offset(size, dtype):
    encoder = nn.Linear(size, 4)
    cache = FrameCache(lambda_module(encoder, dtype), observation_ndim=1)
    memory = torch.randint(0, 255, (1 + 3 * 5 * size,)).to(dtype)
    for offset in (0, 1):
        stream = memory[offset : offset + 3 * 5 * size].view(3, 5, size)
        cache(stream[:, :4])
        for index in range(size):
            changed = stream[:, 1:].clone()
            changed[1, 1, index] += 1
            expected = encoder(changed.float())
            torch.testing.assert_close(cache(changed), expected, rtol=0, atol=1e-4)
            cache(stream[:, :4])


def lambda_module(encoder, dtype):
    class AsFloat(nn.Module):
        def __init__(self):
            super().__init__()
            self.encoder = encoder

        def forward(self, x):
            return self.encoder(x.float())

    return AsFloat()


def test_histories_that_their_owner_writes_into():
    backbone, _, shape = make()
    history = torch.randn(5, 4, *shape)
    with backbone.acting():
        for _ in range(4):
            assert_exact(backbone, history)
            history[:, :-1] = history[:, 1:].clone()
            history[:, 0] += 1  # a frame that was never seen
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
        kept = backbone._cache._kept
        words, tokens = kept.words.entries, kept.tokens.entries
        assert tokens.shape == (3, 3, 2, 16)
        assert words.untyped_storage().nbytes() == 2 * (3 * 3 * 3 * 4)  # with room for as many
        assert tokens.untyped_storage().nbytes() == 2 * (3 * 3 * 2 * 16 * 4)
    assert backbone._cache is None


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
def test_copies_act_with_nothing_kept(copied):
    backbone, network, shape = make()
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        features(backbone, stream[:, :4])
        twin = copied(backbone)
        assert twin._cache._kept is None
        frames, original = CountedFrames(twin.module), CountedFrames(network)
        assert_exact(twin, stream[:, 1:5])
        assert frames.take() == 20 + 20  # both the backbone and the network encode all
        next(twin.module.frame_encoder.parameters()).add_(1)
        assert_exact(twin, stream[:, 2:6])
        assert original.take() == 0
    assert copied(backbone)._cache is None


def test_a_state_dict_is_the_networks_and_empties_the_cache():
    backbone, network, shape = make()
    names = set(backbone.state_dict())
    frames = CountedFrames(network)
    stream = torch.randn(5, 6, *shape)
    with backbone.acting():
        features(backbone, stream[:, :4])
        assert set(nn.Sequential(backbone).state_dict()) == {f"0.{name}" for name in names}
        frames.take()
        features(backbone, stream[:, 1:5])
        assert frames.take() == 20
        backbone.clear_cache()
        features(backbone, stream[:, 2:6])
        assert frames.take() == 20


def test_a_run_that_goes_on_gives_the_bits_of_one_that_is_resumed():
    backbone, _, shape = make(steps=16)
    stream = torch.randn(5, 40, *shape)

    def act(backbone, start, stop):
        return [features(backbone, stream[:, i : i + 16]) for i in range(start, stop)]

    with backbone.acting():
        act(backbone, 0, 8)
        state = backbone.state_dict()
        going_on = act(backbone, 8, 16)
    resumed = make(steps=16)[0]
    resumed.load_state_dict(state)
    with resumed.acting():
        assert all(map(torch.equal, going_on, act(resumed, 8, 16)))


def test_acting_finds_every_backbone_of_a_policy():
    first, second = make()[0], make("vanilla")[0]
    policy = nn.ModuleList([first, nn.Sequential(second), nn.Linear(1, 1)])
    with acting(policy):
        assert first._cache is not None
        assert second._cache is not None
    assert first._cache is second._cache is None
    with acting(lambda td: td):
        pass
