"""OFENet and D2RL of the authors' release."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from torchrl_tit.interop.weights import count_layers, load_renamed, size_of, strip_prefix
from torchrl_tit.networks import D2RL, OFENet


def ofenet_from_official(config: Mapping[str, Any], params: Mapping[str, Tensor]) -> nn.Module:
    """Builds OFENet; see :func:`~torchrl_tit.interop.from_official`."""
    return _from_official(OFENet, config, params)


def d2rl_from_official(config: Mapping[str, Any], params: Mapping[str, Tensor]) -> nn.Module:
    """Builds D2RL; see :func:`~torchrl_tit.interop.from_official`."""
    return _from_official(D2RL, config, params)


def _from_official(
    network_class: type[OFENet] | type[D2RL],
    config: Mapping[str, Any],
    params: Mapping[str, Tensor],
) -> nn.Module:
    first = "linear1_policy.0.weight"
    params = strip_prefix(params, first)
    num_layers = count_layers(params, r"linear(\d+)_policy\..*")
    size = size_of(params, first, axis=1)
    (size,) = config.get("observation_shape", (size,))
    network = network_class(
        (size,),
        hidden_dim=config.get("hidden_dim", size_of(params, first)),
        num_layers=num_layers,
    )
    renaming = [
        (rf"linear{index + 1}_{trunk}\.0\.(.*)", rf"{trunk}.history_encoder.layers.{index}.\1")
        for index in range(num_layers)
        for trunk in ("policy", "value")
    ]
    load_renamed(network, params, renaming)
    # The authors' arrays have no history axis.
    return nn.Sequential(nn.Unflatten(-1, (1, size)), network)
