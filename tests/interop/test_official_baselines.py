"""The baselines of the authors' release, built from their weights."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference_baselines import ReferenceCatformer, ReferenceResNet, ReferenceTrunks
from tests.numerics import assert_near
from torchrl_tit.interop import from_official

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

IMAGE = (4, 20, 20)


def randomized(network: nn.Module) -> dict[str, Tensor]:
    """Draws parameters in which every one matters and outputs stay of order 1; their dict."""
    torch.manual_seed(1)
    for name, parameter in network.named_parameters():
        if parameter.ndim == 1:
            offset = 1.0 if "ln" in name and name.endswith("weight") else 0.0
            nn.init.normal_(parameter, offset, 0.2)
        elif parameter.ndim > 1:
            nn.init.normal_(parameter, std=1 / parameter[0].numel() ** 0.5)
    return dict(network.state_dict())


def assert_same(ours: nn.Module, reference: nn.Module, observations: Tensor) -> None:
    x, y = (observations.clone().requires_grad_() for _ in range(2))
    found, expected = ours(x), reference(y)
    assert type(found) is type(expected)
    if isinstance(expected, Tensor):
        found, expected = [found], [expected]
    assert_near(list(found), list(expected))
    probes = [torch.randn_like(features) for features in expected]
    for features in (found, expected):
        sum((a * b).sum() for a, b in zip(features, probes, strict=True)).backward()
    assert_near(x.grad, y.grad)
    assert all(features.std() > 0.05 for features in expected)


@pytest.mark.parametrize("kind", ["ofenet", "d2rl"])
@pytest.mark.parametrize(("size", "hidden", "layers"), [(11, 64, 2), (1, 8, 2), (17, 32, 4)])
@pytest.mark.parametrize("prefix", ["", "mlp_extractor."])
def test_trunks(kind: str, size: int, hidden: int, layers: int, prefix: str) -> None:
    reference = ReferenceTrunks(kind, size, hidden, layers)
    params = {prefix + name: value for name, value in randomized(reference).items()}
    if prefix:
        params["value_net.weight"] = torch.ones(1, 3)
    whole = {"observation_shape": [size], "hidden_dim": hidden, "outputs": ["", ""]}
    for config in ({"kind": kind}, {"kind": kind, **whole}):
        network = from_official(config, params)
        assert_same(network, reference, torch.randn(5, size))
    assert not torch.allclose(*network(torch.randn(5, size)))  # trunks have weights of their own


@pytest.mark.parametrize(
    ("shape", "features"),
    [((4, 20, 20), 32), ((1, 8, 24), 5), ((4, 84, 84), 512), ((3, 36, 27), 7)],
)
@pytest.mark.parametrize("prefix", ["", "features_extractor."])
def test_resnet(shape: tuple[int, int, int], features: int, prefix: str) -> None:
    reference = ReferenceResNet(shape, features)
    params = {prefix + name: value for name, value in randomized(reference).items()}
    if prefix:
        params["action_net.weight"] = torch.ones(2, features)
    config: dict[str, Any] = {"kind": "resnet", "observation_shape": list(shape)}
    for more in ({}, {"features_dim": features}):
        assert_same(from_official({**config, **more}, params), reference, torch.rand(2, *shape))


@pytest.mark.parametrize(
    ("shape", "features", "settings"),
    [
        ((4, 20, 20), 32, {}),
        ((4, 84, 84), 512, {}),
        ((1, 20, 20), 8, {}),
        ((3, 8, 24), 8, {"dim": 24, "heads": 3, "blocks": 1}),
        ((5, 20, 20), 8, {"dim": 24, "heads": 4, "blocks": 3, "ffn_expansion": 2}),
        ((4, 20, 20), 8, {"dim": 24, "heads": 4, "attention_expansion": 2}),
    ],
)
def test_catformer(shape: tuple[int, int, int], features: int, settings: dict[str, Any]) -> None:
    reference = ReferenceCatformer(shape, features, **settings)
    params = randomized(reference)
    config = {"kind": "catformer", "observation_shape": list(shape)}
    if "heads" in settings:
        config["num_heads"] = settings["heads"]
    assert_same(from_official(config, params), reference, torch.rand(2, *shape))
    bytes_in = torch.randint(0, 256, (2, *shape), dtype=torch.uint8)
    assert_near(from_official(config, params)(bytes_in), reference(bytes_in / 255))


KINDS: dict[str, tuple[Callable[[], nn.Module], dict[str, Any], dict[str, Any], str, str]] = {
    # What makes the reference, its config, entries that do not fit, a parameter and our name of it.
    "resnet": (
        partial(ReferenceResNet, IMAGE, 8),
        {"observation_shape": list(IMAGE)},
        {"features_dim": 9, "observation_shape": [4, 28, 28]},
        "resnet.2.cnn.0.bias",
        "layers.2.conv.bias",
    ),
    "catformer": (
        partial(ReferenceCatformer, IMAGE, 8),
        {"observation_shape": list(IMAGE)},
        {"features_dim": 9, "observation_shape": [4, 28, 28]},
        "resnet.2.cnn.0.bias",
        "layers.2.conv.bias",
    ),
    **{
        kind: (
            partial(ReferenceTrunks, kind, 11, 64),
            {"observation_shape": [11]},
            {"hidden_dim": 32, "observation_shape": [12]},
            "linear2_value.0.bias",
            "value.history_encoder.layers.1.bias",
        )
        for kind in ("ofenet", "d2rl")
    },
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_does_not_fit_is_named(kind: str) -> None:
    make, config, others, theirs, ours = KINDS[kind]
    config = {"kind": kind, **config}
    params = randomized(make())
    for entry, value in others.items():
        with pytest.raises(ValueError, match=r"\w has shape .* instead of "):
            from_official({**config, entry: value}, params)
    with pytest.raises(ValueError, match=rf"missing .*{ours}"):
        from_official(config, {n: p for n, p in params.items() if n != theirs})
    with pytest.raises(ValueError, match="unknown parameter 'extra'"):
        from_official(config, {**params, "extra": torch.ones(1)})
    with pytest.raises(ValueError, match=r"no parameter '(resnet.0|linear1_policy.0).weight'"):
        from_official(config, {})
    if kind in ("resnet", "catformer"):
        with pytest.raises(ValueError, match="has no entry 'observation_shape'"):
            from_official({"kind": kind}, params)
