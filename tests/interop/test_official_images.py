"""ResNet and Catformer of the authors' release, built from their weights."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference_baselines import ReferenceCatformer, ReferenceResNet
from tests.numerics import assert_near
from torchrl_tit.interop import from_official

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


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


def assert_same(ours: nn.Module, reference: nn.Module, images: Tensor) -> None:
    x, y = (images.clone().requires_grad_() for _ in range(2))
    features, expected = ours(x), reference(y)
    probe = torch.randn_like(expected)
    (features * probe).sum().backward()
    (expected * probe).sum().backward()
    assert_near(features, expected)
    assert_near(x.grad, y.grad)
    assert expected.std() > 0.05


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
    images = torch.rand(2, *shape)
    assert_same(from_official(config, params), reference, images)
    assert_same(from_official({**config, "features_dim": features}, params), reference, images)


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


@pytest.mark.parametrize("kind", ["resnet", "catformer"])
def test_what_does_not_fit_is_named(kind: str) -> None:
    make: Any = {"resnet": ReferenceResNet, "catformer": ReferenceCatformer}[kind]
    params = randomized(make((4, 20, 20), 8))
    config: dict[str, Any] = {"kind": kind, "observation_shape": [4, 20, 20]}
    with pytest.raises(ValueError, match="has no entry 'observation_shape'"):
        from_official({"kind": kind}, params)
    with pytest.raises(ValueError, match=r"head.* has shape .*8.* instead of .*9"):
        from_official({**config, "features_dim": 9}, params)
    with pytest.raises(ValueError, match="has shape"):
        from_official({**config, "observation_shape": [4, 28, 28]}, params)
    with pytest.raises(ValueError, match=r"missing .*layers.2.conv.bias"):
        from_official(config, {n: p for n, p in params.items() if n != "resnet.2.cnn.0.bias"})
    with pytest.raises(ValueError, match="unknown parameter 'extra'"):
        from_official(config, {**params, "extra": torch.ones(1)})
    with pytest.raises(ValueError, match=r"no parameter 'resnet.0.weight'"):
        from_official(config, {})
