"""Every output, gradient and attention map against the independent reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from tests.networks.maps import attention_maps
from tests.networks.reference import ReferenceTIT, copy_parameters, matched_parameters, randomize
from tests.numerics import assert_near
from torchrl_tit.networks import EnhancedTIT, HistoryNetwork, VanillaTIT

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

NETWORKS: dict[str, dict[str, Any]] = {
    "vanilla": {"variant": "vanilla"},
    "enhanced": {},
    "without dense": {"dense": False},
    "without inner": {"inner": False},
    "without outer": {"outer": False},
}

# Name: observation shape, number of frames K, hyperparameters.
CASES: dict[str, tuple[tuple[int, ...], int, dict[str, Any]]] = {
    "array, K=1": ((4,), 1, {}),
    "array, K=4": ((5,), 4, {"num_heads_inner": 4, "num_heads_outer": 2}),
    "D=11, P=4": ((11,), 2, {"patch_size": 4}),
    "P = D": ((5,), 2, {"patch_size": 5}),
    "expansions": ((4,), 2, {"ffn_expansion_inner": 1, "ffn_expansion_outer": 2}),
    "relu, tanh, gelu": (
        (4,),
        2,
        {"activation_inner": "relu", "activation_outer": "tanh", "activation_head": "gelu"},
    ),
    "no positions": ((4,), 2, {"position_encoding": False}),
    "temporal positions": ((4,), 4, {"temporal_positions": "learned"}),
    "shared blocks": ((4,), 2, {"share_blocks": True, "num_blocks": 3}),
    "one block": ((4,), 2, {"num_blocks": 1}),
    "three blocks": ((4,), 3, {"num_blocks": 3}),
    "image": ((12, 12), 2, {"patch_size": 4, "num_heads_inner": 2}),
    "wide image of three channels": ((3, 8, 12), 4, {"patch_size": 4, "num_heads_outer": 2}),
}

PAIRS = [
    (network, case)
    for network, kind in NETWORKS.items()
    for case, (_, _, settings) in CASES.items()
    # Temporal positions are for outer blocks.
    if kind.get("outer", True) or "temporal_positions" not in settings
]


def make_pair(
    network: str, shape: tuple[int, ...], num_frames: int, **settings: Any
) -> tuple[HistoryNetwork, ReferenceTIT]:
    kind = NETWORKS[network]
    settings = {"embed_dim": 16, "features_dim": 12} | settings
    reference = ReferenceTIT(shape, num_frames, **settings, **kind)
    ours: HistoryNetwork
    if kind.get("variant") == "vanilla":
        ours = VanillaTIT(shape, num_frames, **settings)
    else:
        ours = EnhancedTIT(shape, num_frames, **settings, **kind)
    randomize(ours)
    copy_parameters(ours, reference)
    return ours, reference


def results(
    network: HistoryNetwork | ReferenceTIT, history: Tensor, probe: Tensor
) -> tuple[Tensor, Tensor]:
    """Features, and the gradient of sum(features * probe) with respect to the input."""
    history = history.detach().clone().requires_grad_()
    features = network(history)
    (features * probe).sum().backward()
    assert history.grad is not None
    return features.detach(), history.grad


def prefixed(name: str) -> Callable[[str], str]:
    return lambda message: f"{name}: {message}"


def gradient(parameter: Tensor) -> Tensor:
    return torch.zeros_like(parameter) if parameter.grad is None else parameter.grad


@pytest.mark.parametrize(("network", "case"), PAIRS)
def test_outputs_and_gradients(network: str, case: str) -> None:
    """In double precision, where nothing but rounding is left."""
    shape, num_frames, settings = CASES[case]
    ours, reference = make_pair(network, shape, num_frames, **settings)
    history = torch.randn(2, num_frames, *shape)
    probe = torch.randn(2, 12)

    features, input_gradient = results(ours, history, probe)
    expected, expected_gradient = results(reference, history, probe)

    torch.testing.assert_close(features, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(input_gradient, expected_gradient, rtol=1e-9, atol=1e-11)
    assert input_gradient.abs().max() > 1e-3, "a gradient that is no gradient proves nothing"
    for name, parameter, theirs in matched_parameters(ours, reference):
        torch.testing.assert_close(
            gradient(parameter), gradient(theirs), rtol=1e-9, atol=1e-10, msg=prefixed(name)
        )


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("leading", [(), (2, 3), (0,)])
@pytest.mark.parametrize(
    "case", ["array, K=1", "array, K=4", "three blocks", "shared blocks", "image", "P = D"]
)
def test_attention_maps(network: str, leading: tuple[int, ...], case: str) -> None:
    shape, num_frames, settings = CASES[case]
    ours, reference = make_pair(network, shape, num_frames, **settings)
    history = torch.randn(*leading, num_frames, *shape)
    maps = attention_maps(ours, history)

    blocks = settings.get("num_blocks", 2)
    assert len(maps.inner) == (0 if network == "without inner" else blocks)
    if network == "without outer":
        assert not maps.outer
    else:
        # Without the dense connection only the last pair's outer block is there.
        assert len(maps.outer) == (1 if network == "without dense" else blocks)
    if 0 in leading:
        assert all(m.shape[: len(leading)] == leading for m in maps.inner + maps.outer)
        return

    _, inner, outer = reference.with_maps(history)
    outer = outer[-len(maps.outer) :] if maps.outer else []
    for weights, expected in zip(maps.inner + maps.outer, inner + outer, strict=True):
        assert_near(weights, expected)
        assert_near(weights.sum(-1), torch.ones(weights.shape[:-1]))
    for weights in maps.outer:
        heads = settings.get("num_heads_outer", 1)
        assert weights.shape == (*leading, heads, num_frames, num_frames)
        assert not weights.triu(1).any(), "a step sees a later one"


@pytest.mark.parametrize("network", ["vanilla", "enhanced"])
def test_only_what_is_read_is_computed(network: str) -> None:
    ours, reference = make_pair(
        network, (84, 84), 4, patch_size=12, embed_dim=64, num_heads_inner=4, num_heads_outer=4
    )
    history = torch.rand(2, 4, 84, 84)

    def flops(module: torch.nn.Module) -> int:
        # Of the attention kernels only the plain one is counted.
        plain, counter = sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False)
        with plain, counter, torch.no_grad():
            module(history)
        return counter.get_total_flops()

    # Of two inner blocks the second needs a query, an output projection and an FFN of the class
    # token only, and keys and values of nobody.
    assert flops(ours) < 0.57 * flops(reference)


DROPOUTS = [
    f"{kind}_dropout_{part}" for kind in ("attention", "ffn") for part in ("inner", "outer")
]


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
@pytest.mark.parametrize("setting", DROPOUTS)
def test_each_dropout_sits_where_its_name_says(kind: Any, setting: str) -> None:
    network = kind((3,), 4, embed_dim=16, **{setting: 0.5})
    what, _, part = setting.split("_")
    side = {"inner": "frame_encoders.observation", "outer": "history_encoder"}[part]
    layer = {"attention": "attention.dropout", "ffn": "ffn.3"}[what]
    active = {n for n, m in network.named_modules() if isinstance(m, torch.nn.Dropout) and m.p}
    assert active == {f"{side}.blocks.{index}.{layer}" for index in range(2)}
