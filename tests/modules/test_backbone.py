"""The backbone as a TensorDictModule, with one or several observations, and one or two trunks."""

from contextlib import nullcontext

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import set_skip_existing
from torch import nn

from tests.modules.frames import CountedFrames
from tests.numerics import assert_near
from torchrl_tit import Backbone, EnhancedTIT, VanillaTIT
from torchrl_tit.networks import MLP, HistoryNetwork, TwoTrunks, build_network
from torchrl_tit.settings import NETWORKS, Flat, Inner, Linear, Outer, PairedOuter

pytestmark = pytest.mark.numerics


@pytest.mark.parametrize(
    ("network", "keys"),
    [
        (EnhancedTIT((4,), 3), {}),
        (VanillaTIT((4,), 3), {"in_keys": [("agent", "past")], "out_keys": [("agent", "seen")]}),
        (EnhancedTIT((4,), 3), {"in_keys": "past", "out_keys": "seen"}),
        (MLP((4,), 3), {"out_keys": ["policy", ("deep", "value")]}),
    ],
    ids=["default", "nested", "names", "two trunks"],
)
@pytest.mark.parametrize("leading", [(), (2, 3)])
@torch.no_grad()
def test_writes_the_outputs_of_the_network(network, keys, leading):
    backbone = Backbone(network, **keys)
    history = torch.randn(*leading, 3, 4)
    td = backbone(TensorDict(batch_size=leading).set(backbone.history_keys[0], history))
    expected = network(history)
    expected = [expected] if isinstance(expected, torch.Tensor) else list(expected)
    assert expected[0].shape == (*leading, 64)
    assert_near([td[key] for key in backbone.features_keys], expected)


@pytest.mark.parametrize("acts", [False, True])
@torch.no_grad()
def test_is_called_as_any_tensordict_module(acts):
    network = EnhancedTIT((4,), num_frames=2)
    backbone = Backbone(network)
    history = torch.randn(5, 2, 4)
    expected = network(history)
    with backbone.acting() if acts else nullcontext():
        td = TensorDict({"history": history}, [5])
        assert backbone(td) is td
        assert_near(td["features"], expected)
        other = TensorDict({}, [5])
        assert backbone(td, tensordict_out=other) is other
        assert_near(other["features"], expected)
        assert_near(backbone(history), expected)
        assert_near(backbone(history=history), expected)
        backbone.inplace = False
        assert set(backbone(td.exclude("features")).keys()) == {"features"}
        backbone.inplace = True
        td["features"] = torch.zeros(5)
        with set_skip_existing(True):
            assert not backbone(td)["features"].any()
        assert backbone(td)["features"].any()
        locked = TensorDict({"history": history, "features": torch.zeros(5, 64)}, [5]).lock_()
        with pytest.raises(RuntimeError, match="lock"):
            backbone(locked)


@torch.no_grad()
def test_entries_by_keyword_and_by_position():
    pair = build_network(NETWORKS["mlp"](2), (4,), trunks="separate")
    backbone = Backbone(pair, [("agent", "history")], ["policy", ("agent", "value")])
    history = torch.randn(5, 2, 4)
    assert_near(backbone(agent_history=history), pair(history))
    backbone.select_out_keys("policy")
    assert_near(backbone(history), pair(history)[0])
    assert set(backbone(TensorDict(agent={"history": history})).keys()) == {"agent", "policy"}
    backbone.reset_out_keys()
    assert backbone.out_keys == ["policy", ("agent", "value")]

    backbone = Backbone(build_network(NETWORKS["lstm"](1), (4,)))
    entries = {key: torch.randn(5, *shape) for key, shape in backbone.state_shapes.items()}
    entries |= {"history": history[:, 1:], "is_init": torch.zeros(5, 1, dtype=torch.bool)}
    td = backbone(TensorDict(entries, [5]))
    assert_near(backbone(**entries), tuple(td[key] for key in backbone.out_keys))


def test_keys_are_fixed():
    backbone = Backbone(EnhancedTIT((4,)))
    backbone.in_keys, backbone.out_keys = ["history"], ["features"]
    for name in ("in_keys", "out_keys"):
        with pytest.raises(AttributeError, match=f"^{name} of a backbone cannot .* build another"):
            setattr(backbone, name, ["other"])
    assert (backbone.in_keys, backbone.out_keys) == (["history"], ["features"])


@pytest.mark.parametrize(
    ("network", "keys", "message"),
    [
        (EnhancedTIT((4,)), {"in_keys": []}, "1 inputs and 1 outputs, but in_keys is \\[\\]"),
        (EnhancedTIT((4,)), {"in_keys": ["a", "b"]}, "1 inputs and 1 outputs"),
        (EnhancedTIT((4,)), {"out_keys": []}, "out_keys is \\[\\]: name one key for each"),
        (MLP((4,)), {}, "MLP has 1 inputs and 2 outputs"),
        (nn.Flatten(), {"in_keys": []}, "Flatten has 1 inputs"),
    ],
)
def test_wrong_numbers_of_keys(network, keys, message):
    with pytest.raises(ValueError, match=message):
        Backbone(network, **keys)


def test_several_inputs_of_another_module():
    backbone = Backbone(nn.Bilinear(3, 4, 5), in_keys=["a", "b"])
    td = TensorDict({"a": torch.randn(6, 3), "b": torch.randn(6, 4)}, [6])
    assert backbone(td)["features"].shape == (6, 5)


def make_two_observations():
    """Pixels and a state: two frame encoders, whose tokens are side by side."""
    return HistoryNetwork(
        {"pixels": Inner(patch_size=4, embed_dim=16), "state": Linear(embed_dim=16)},
        PairedOuter(),
        observation_shape={"pixels": (8, 8), "state": (3,)},
        num_frames=4,
    )


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("trunks", ["shared", "separate"])
@torch.no_grad()
def test_several_observations_and_trunks_in_acting_mode(trunks):
    each = [make_two_observations() for _ in range(1 if trunks == "shared" else 2)]
    network = each[0] if trunks == "shared" else TwoTrunks(*each)
    for parameter in network.parameters():  # far from 0, so that a wrong token shows
        parameter.add_(0.1 * torch.randn_like(parameter))
    out_keys = ["policy", "value"][: len(each)]
    backbone = Backbone(network, ["pixels", ("low", "state")], out_keys)
    frames = [CountedFrames(trunk) for trunk in each]
    pixels = torch.randint(0, 256, (5, 9, 8, 8), dtype=torch.uint8)
    states = torch.randn(5, 9, 3)
    with backbone.acting():
        for start in range(5):
            window = slice(start, start + 4)
            if start == 3:  # a change of one observation, in one place
                states[2, 4] += 1
            td = TensorDict({"pixels": pixels[:, window], "low": {"state": states[:, window]}}, [5])
            backbone(td)
            new = {0: 20 + 20, 3: 5 + 5 + 1}.get(start, 5 + 5)
            assert [counted.take() for counted in frames] == [new] * len(frames)
            expected = [trunk(pixels[:, window], states[:, window]) for trunk in each]
            assert_near([td[key] for key in out_keys], expected)
            assert td.keys() == {"pixels", "low", *out_keys}
            for counted in frames:
                counted.take()
    with pytest.raises(KeyError, match=r"no history under \('low', 'state'\), only") as error:
        backbone(td.exclude(("low", "state")))
    assert "\n" not in str(error.value)


def test_bytes_and_floats_of_flat_frames_stand_side_by_side():
    """Bytes are numbers from 0 to 1 there, as everywhere."""
    network = HistoryNetwork(
        {"pixels": Flat(), "state": Flat()},
        Outer(),
        observation_shape={"pixels": (2, 4), "state": (8,)},
        num_frames=3,
    )
    pixels = torch.randint(0, 256, (5, 3, 2, 4), dtype=torch.uint8)
    state = torch.randn(5, 3, 8)
    assert_near(network(pixels, state), network(pixels / 255, state))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_features_under_autocast_have_the_dtype_of_the_weights(dtype):
    backbone = Backbone(EnhancedTIT((4,), num_frames=3), autocast=torch.bfloat16).to(dtype)
    td = TensorDict({"history": torch.randn(2, 3, 4, dtype=dtype)}, [2])
    assert backbone(td)["features"].dtype == dtype


@pytest.mark.parametrize("acts", [False, True])
def test_autocast_computes_in_bfloat16_and_writes_float32(acts):
    torch.manual_seed(0)
    network = TwoTrunks(EnhancedTIT((4,), num_frames=3), EnhancedTIT((4,), num_frames=3))
    backbone = Backbone(network, out_keys=["a", "b"], autocast=torch.bfloat16)
    seen = []
    for trunk in (network.policy, network.value):
        trunk.get_submodule("head.1").register_forward_hook(
            lambda module, args, out: seen.append(out.dtype)
        )
    history = torch.randn(32, 3, 4)
    full = network(history)
    with backbone.acting() if acts else nullcontext(), torch.set_grad_enabled(not acts):
        td = backbone(TensorDict({"history": history}, [32]))
    assert seen == [torch.float32] * 2 + [torch.bfloat16] * 2
    for key, expected in zip(["a", "b"], full, strict=True):
        assert td[key].dtype == torch.float32
        assert 0 < (td[key] - expected).abs().max() < 0.2
    if not acts:
        td["a"].square().sum().backward()
        gradients = [p.grad for p in network.policy.parameters() if p.grad is not None]
        assert {gradient.dtype for gradient in gradients} == {torch.float32}
