"""OFENet and D2RL of the authors' release, built from their weights."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.networks.reference_baselines import ReferenceTrunks
from tests.numerics import assert_near
from torchrl_tit.interop import from_official

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

KINDS = pytest.mark.parametrize("kind", ["ofenet", "d2rl"])


@KINDS
@pytest.mark.parametrize(("size", "hidden", "layers"), [(11, 64, 2), (1, 8, 2), (17, 32, 4)])
@pytest.mark.parametrize("prefix", ["", "mlp_extractor."])
def test_equals_the_reference(kind: str, size: int, hidden: int, layers: int, prefix: str) -> None:
    torch.manual_seed(0)
    reference = ReferenceTrunks(kind, size, hidden, layers)
    params = {prefix + name: value for name, value in reference.state_dict().items()}
    if prefix:
        params["value_net.weight"] = torch.ones(1, 3)
    x = torch.randn(5, size, requires_grad=True)
    y = x.detach().clone().requires_grad_()
    expected = reference(y)
    probes = [torch.randn_like(latent) for latent in expected]
    sum((a * b).sum() for a, b in zip(expected, probes, strict=True)).backward()
    for config in (
        {"kind": kind},
        {"kind": kind, "observation_shape": [size], "hidden_dim": hidden, "outputs": ["", ""]},
    ):
        latents = from_official(config, params)(x)
        assert isinstance(latents, tuple)
        assert_near(latents, expected)
    sum((a * b).sum() for a, b in zip(latents, probes, strict=True)).backward()
    assert_near(x.grad, y.grad)
    assert not torch.allclose(*latents)  # the trunks have weights of their own


@KINDS
def test_what_does_not_fit_is_named(kind: str) -> None:
    params = ReferenceTrunks(kind, 11, 64).state_dict()
    config: dict[str, Any] = {"kind": kind, "observation_shape": [11]}
    with pytest.raises(ValueError, match=r"policy.history_encoder.layers.0.weight has shape"):
        from_official({**config, "hidden_dim": 32}, params)
    with pytest.raises(ValueError, match=r"policy.history_encoder.layers.0.weight has shape"):
        from_official({**config, "observation_shape": [12]}, params)
    with pytest.raises(ValueError, match=r"missing value.history_encoder.layers.1.bias"):
        from_official(config, {n: p for n, p in params.items() if n != "linear2_value.0.bias"})
    with pytest.raises(ValueError, match=r"no parameter 'linear1_policy.0.weight'"):
        from_official(config, {})
