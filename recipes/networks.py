"""The networks that a recipe can name, with their settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torchrl_tit.networks import (
    EnhancedTIT,
    EnhancedTITConfig,
    HistoryNetwork,
    VanillaTIT,
    VanillaTITConfig,
)

NetworkConfig = EnhancedTITConfig | VanillaTITConfig
"""Settings of a network: a recipe's field ``backbone``."""

NETWORKS: dict[str, tuple[type[NetworkConfig], Callable[..., HistoryNetwork]]] = {
    "vanilla-tit": (VanillaTITConfig, VanillaTIT),
    "enhanced-tit": (EnhancedTITConfig, EnhancedTIT),
}
"""Settings and network by the name that recipes use."""


def make_network(
    config: NetworkConfig, observation_shape: Sequence[int], history: int
) -> HistoryNetwork:
    """Builds the network that settings describe, for observations of a shape and K of them."""
    network = next(network for kind, network in NETWORKS.values() if kind is type(config))
    return network(observation_shape, history, config)
