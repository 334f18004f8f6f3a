"""A backbone in TorchRL's recurrent mode: sequences of steps, with each frame encoded once."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import InitTracker
from torchrl.modules import set_recurrent_mode

from tests.modules.frames import CountedFrames
from tests.networks.test_pairs import (
    APART,
    CASES,
    NUM_FRAMES,
    OF_KINDS,
    N,
    Pair,
    T,
    build,
    network_of,
    sequences,
)
from tests.numerics import assert_near
from torchrl_tit import Backbone, EnhancedTIT, settings
from torchrl_tit.envs import make_env
from torchrl_tit.modules import history_keys
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings.choices import Padding

pytestmark = pytest.mark.numerics

PADDINGS: list[Padding] = ["same", "constant"]
PADDED = [(pair, "same") for pair in CASES]
PADDED += [(pair, "constant") for pair in {**dict.fromkeys(APART), **OF_KINDS}]
# Those that read tables, whole windows, and other inputs; test_pairs.py compiles the encoders.
COMPILED = ["outer", "outer, sliding", "paired-outer", "chained-outer", "gtrxl", "lstm"]
COMPILED += ["decision-transformer"]
CASE = ("inner", "paired-outer")


def backbone_of(network: HistoryNetwork, **options: Any) -> Backbone:
    several = len(network.observations) > 1
    keys = history_keys(network.observations) if several else ["history"]
    return Backbone(network, in_keys=[*keys, *network.history_encoder.context], **options)


def read(backbone: Backbone, td: TensorDictBase, key: str = "features") -> Tensor:
    with set_recurrent_mode(True):
        return backbone(td)[key]


def gradients(features: Tensor, network: torch.nn.Module) -> list[Tensor]:
    probe = torch.linspace(-1, 1, features.numel(), dtype=features.dtype).view_as(features)
    weights = [w for name, w in network.named_parameters() if "mask_token" not in name]
    return list(torch.autograd.grad((features * probe).sum(), weights))


@pytest.mark.parametrize(("pair", "padding"), PADDED, ids=str)
def test_every_pair_equals_single_steps(pair: Pair, padding: Padding) -> None:
    network = network_of(pair)
    td = sequences(pair, padding)
    expected = backbone_of(network)(td.clone())["features"]
    expected_gradients = gradients(expected, network)
    for options in ({}, {"padding": padding}):
        features = read(backbone_of(network, **options), td.clone())
        torch.testing.assert_close(features, expected, rtol=0, atol=1e-9)
        for actual, other in zip(gradients(features, network), expected_gradients, strict=True):
            torch.testing.assert_close(
                actual, other, rtol=0, atol=1e-9 * (1 + other.abs().max().item())
            )


def test_vmap_over_stored_histories_is_refused() -> None:
    """How many of them count depends on the data."""
    td = sequences(CASE, "same")
    backbone = backbone_of(network_of(CASE))
    with set_recurrent_mode(True), pytest.raises(ValueError, match="use deactivate_vmap=True"):
        torch.vmap(backbone)(torch.stack([td, td]))


@pytest.mark.parametrize("padding", [None, *PADDINGS])
def test_without_histories_the_valid_steps_are_those_of_single_steps(
    padding: Padding | None,
) -> None:
    network = build(CASE).double()
    td = sequences(CASE, padding or "same")
    expected = Backbone(network)(td.clone())["features"]
    out = TensorDict(dict(td.exclude("history").items()), [N, T])
    features = read(Backbone(network, padding=padding), out)
    valid = out["features_valid"]
    assert valid.shape == (N, T, 1)
    assert valid.dtype == torch.bool
    # K - 1 = 2 steps of the sequences that begin inside an episode.
    assert (~valid).squeeze(-1).nonzero().tolist() == [[1, 0], [1, 1], [2, 0], [2, 1]]
    mask = valid.squeeze(-1)
    assert_near(features[mask], expected[mask])
    assert (features - expected)[~mask].abs().amax(-1).min() > 1e-3


@pytest.mark.parametrize("padding", PADDINGS)
def test_each_frame_is_encoded_once(padding: Padding) -> None:
    network = EnhancedTIT((4,), num_frames=16).double()
    counted, td = CountedFrames(network), rollout_of(16, padding)
    read(Backbone(network, padding=padding), td.clone())
    assert counted.take() == 3 * (60 + 15) + (padding == "constant")  # zeros once
    starts = int(td["is_init"].sum())
    assert starts > 3
    read(Backbone(network), td.clone())
    assert counted.take() == 3 * 60 + 15 * starts
    read(Backbone(network), td.exclude("history"))
    assert counted.take() == 3 * 60


def test_dropout_is_drawn_once_a_frame() -> None:
    frame = settings.Inner(patch_size=3, ffn_dropout=0.5, attention_dropout=0.5)
    network = HistoryNetwork(
        frame, settings.Outer(), observation_shape=(6,), num_frames=NUM_FRAMES
    ).double()
    network.history_encoder.eval()
    td = sequences(CASE, "same")[2:]
    torch.manual_seed(0)
    features = read(Backbone(network, padding="same"), td.clone())
    frames = torch.cat([td["history"][0, 0], td["observation"][0, 1:]])
    torch.manual_seed(0)
    tokens = network.frames[0](frames).unfold(0, NUM_FRAMES, 1).movedim(-1, 1)
    assert_near(features[0], network.encode_history(tokens))
    assert not torch.equal(read(Backbone(network, padding="same"), td.clone()), features)


@pytest.mark.parametrize("history", COMPILED)
def test_compiles_without_a_graph_break(history: str) -> None:
    torch.compiler.reset()
    pair = ("linear", history)
    network = network_of(pair)
    backbone = backbone_of(network, padding="same")
    td = sequences(pair, "same")

    def features(td: TensorDictBase) -> Tensor:
        return read(backbone, td.copy())

    compiled = torch.compile(features, backend="eager", fullgraph=True)
    with torch.no_grad():
        assert_near(compiled(td), features(td))
    torch.compiler.reset()


def rollout_of(num_frames: int, padding: Padding) -> TensorDictBase:
    env = make_env("CartPole-v1", 3, num_frames=num_frames, padding=padding, seed=0)
    torch.manual_seed(0)
    rollout = env.append_transform(InitTracker()).rollout(60, break_when_any_done=False)
    return rollout.apply(lambda x: x.double() if x.is_floating_point() else x)


@pytest.mark.parametrize("padding", PADDINGS)
def test_flat_batches_of_a_slice_sampler(padding: Padding) -> None:
    rollout = rollout_of(4, padding)
    network = EnhancedTIT((4,), 4).double()

    def draw(**options: Any) -> tuple[TensorDictBase, Tensor]:
        sampler = SliceSampler(slice_len=8, end_key=("next", "done"), **options)
        storage = LazyTensorStorage(180, ndim=2)
        buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=400)
        buffer.extend(rollout)
        torch.manual_seed(0)
        flat = buffer.sample()
        assert flat.shape == (400,)
        return flat, Backbone(network)(flat.select("history"))["features"]

    flat, expected = draw()  # the sampler sets is_init at the beginning of each slice
    assert_near(read(Backbone(network), flat), expected)
    # Without histories, is_init must tell episodes from slices.
    flat, expected = draw(init_key=None)
    assert 0 < flat["is_init"].sum() < 25
    flat = flat.exclude("history")
    features, valid = read(Backbone(network, padding=padding), flat), flat["features_valid"]
    starts = flat["is_init"].sum()
    assert (~valid).sum() == 3 * (50 - starts)
    assert_near(features[valid.squeeze(-1)], expected[valid.squeeze(-1)])


def test_trajectories_that_a_collector_filled_up() -> None:
    """With ``split_trajs``, zeros follow a trajectory, though it need not be done there."""
    rollout = rollout_of(4, "same")
    count = torch.arange(180).view(3, 60)
    rollout["collector", "traj_ids"] = count // 60 + 3 * rollout["is_init"].squeeze(-1).cumsum(1)
    filled = split_trajectories(rollout, trajectory_key=("collector", "traj_ids"))
    mask = filled["collector", "mask"]
    last = mask & ~torch.cat([mask[:, 1:], torch.zeros_like(mask[:, :1])], 1)
    assert not filled["next", "done"][last].all()
    backbone = Backbone(EnhancedTIT((4,), 4).double())
    expected = backbone(filled.select("history"))["features"]
    assert_near(read(backbone, filled)[mask], expected[mask])


def test_every_frame_and_leading_dimensions() -> None:
    pair = ("linear", "decision-transformer")
    network = network_of(pair)
    td = sequences(pair, "same")
    expected = backbone_of(network, every_frame=True)(td.clone())["features"]
    assert expected.shape == (N, T, NUM_FRAMES, 4)
    assert_near(read(backbone_of(network, every_frame=True, padding="same"), td.clone()), expected)
    deep = td.unsqueeze(0).unsqueeze(2).expand(2, N, 1, T)
    features = read(backbone_of(network, padding="same"), deep.clone())
    assert features.shape == (2, N, 1, T, 4)
    assert_near(features[1, :, 0], expected[:, :, -1])


def test_other_modules_read_the_windows() -> None:
    td = sequences(CASE, "constant")
    module = torch.nn.Flatten(-2)
    features = read(Backbone(module, padding="constant"), td.clone())
    assert torch.equal(features, td["history"].flatten(-2))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda td: td.exclude("observation"), KeyError,
         "have no 'observation' here, only history"),
        (lambda td: td.exclude("is_init", "history"), KeyError, "no 'is_init'.*add .*InitTracker"),
        (lambda td: td[0, 0], ValueError, "this tensordict has none: read a single step within"),
        (lambda td: td.set("observation", torch.zeros(N, T, 5, dtype=torch.float64)), ValueError,
         r"observations of shape \(5,\) do not fit this network: expected \(6,\)"),
        (lambda td: td.set("history", td["history"][:, :, :2]), ValueError,
         "which is 3 observations of shape"),
        (lambda td: td.set("observation", td["observation"] * 2), ValueError,
         "'observation', but it is not the newest frame of 'history': name .* observation_keys"),
        (lambda td: td.set("observation", td["observation"].int()), TypeError,
         "int32 does not fit this network"),
    ],
)  # fmt: skip
def test_wrong_sequences_say_what_to_do(change: Any, error: type[Exception], message: str) -> None:
    backbone = Backbone(EnhancedTIT((6,), NUM_FRAMES).double())
    with pytest.raises(error, match=message) as raised:
        read(backbone, change(sequences(CASE, "same")))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("padding", [None, "same"])
def test_shuffled_steps_are_refused(padding: Padding | None) -> None:
    steps = rollout_of(4, "same").reshape(-1)
    backbone = Backbone(EnhancedTIT((4,), 4).double(), padding=padding)
    torch.manual_seed(0)
    shuffled = steps[torch.randperm(len(steps))]
    expected = backbone(shuffled.clone())["features"]
    with pytest.raises(ValueError, match="leave is_init out of shuffled steps") as raised:
        read(backbone, shuffled.clone())
    assert "\n" not in str(raised.value)
    assert_near(read(backbone, shuffled.exclude("is_init")), expected)
    # Losses that select the in_keys leave out "done" and the next observations.
    bare = shuffled.select("history", "observation", "is_init")
    if padding is None:
        assert_near(read(backbone, bare), expected)
        # The rows of a rollout one after another, of which only some are done.
        assert_near(read(backbone, steps.clone()), backbone(steps)["features"])
    else:
        with pytest.raises(ValueError, match="leave padding out"):
            read(backbone, bare)


@pytest.mark.parametrize("done", [True, False])
def test_histories_say_where_sequences_begin(done: bool) -> None:
    """In the next steps of a loss, nothing else does."""
    rollout = rollout_of(4, "same")
    after = rollout["next"].select("history", "observation", *["done"] * done)
    after["is_init"] = torch.zeros_like(rollout["is_init"])
    network = EnhancedTIT((4,), 4).double()
    expected = Backbone(network)(after.clone())["features"]
    assert_near(read(Backbone(network), after.clone()), expected)
    with pytest.raises(ValueError, match="for the next steps of a loss or GAE") as raised:
        read(Backbone(network, padding="same"), after.clone())
    assert "\n" not in str(raised.value)
    with pytest.raises(ValueError, match="and if History pads otherwise"):
        read(Backbone(network, padding="constant"), rollout)


def test_settings_declare_keys_or_say_what_to_do() -> None:
    network = EnhancedTIT((4,), 3)
    for options in ({"padding": "same"}, {"observation_keys": ["observation"]}):
        assert Backbone(network, **options).in_keys == ["history", "observation", "is_init"]
    with pytest.raises(ValueError, match="padding"):
        Backbone(network, padding="zeros")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"observation_keys is \['a', 'b'\]: name one for each"):
        Backbone(network, observation_keys=["a", "b"])
