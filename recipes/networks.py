"""The networks that a recipe can name, with their settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NoReturn

from torchrl_tit.modules import LSTMConfig
from torchrl_tit.networks import (
    D2RL,
    MLP,
    Catformer,
    CatformerConfig,
    CoBERL,
    CoBERLConfig,
    D2RLConfig,
    DecisionTransformerConfig,
    EnhancedTIT,
    EnhancedTITConfig,
    HistoryNetwork,
    MLPConfig,
    NatureCNN,
    NatureCNNConfig,
    OFENet,
    OFENetConfig,
    ResNet,
    ResNetConfig,
    TwoTrunkNetwork,
    VanillaTIT,
    VanillaTITConfig,
)

NetworkConfig = (
    EnhancedTITConfig
    | VanillaTITConfig
    | NatureCNNConfig
    | ResNetConfig
    | CatformerConfig
    | CoBERLConfig
    | MLPConfig
    | OFENetConfig
    | D2RLConfig
    | LSTMConfig
    | DecisionTransformerConfig
)
"""Settings of a network: a recipe's field ``backbone``."""

Network = HistoryNetwork | TwoTrunkNetwork


def _remembers(*_arguments: object) -> NoReturn:
    raise ValueError("an lstm carries its state from step to step: use a ppo recipe")


def _reads_more(*_arguments: object) -> NoReturn:
    raise ValueError(
        "a decision-transformer reads returns and actions beside a history: use a dt or odt recipe"
    )


NETWORKS: dict[str, tuple[type[NetworkConfig], Callable[..., Network]]] = {
    "enhanced-tit": (EnhancedTITConfig, EnhancedTIT),
    "vanilla-tit": (VanillaTITConfig, VanillaTIT),
    "nature-cnn": (NatureCNNConfig, NatureCNN),
    "resnet": (ResNetConfig, ResNet),
    "catformer": (CatformerConfig, Catformer),
    "coberl": (CoBERLConfig, CoBERL),
    "mlp": (MLPConfig, MLP),
    "ofenet": (OFENetConfig, OFENet),
    "d2rl": (D2RLConfig, D2RL),
    "lstm": (LSTMConfig, _remembers),
    "decision-transformer": (DecisionTransformerConfig, _reads_more),
}
"""Settings and network by the name that recipes use."""


def make_network(config: NetworkConfig, observation_shape: Sequence[int], history: int) -> Network:
    """Builds the network that settings describe, for observations of a shape and K of them.

    Raises:
        ValueError: if the network cannot read them, or has no use for K = 1.
    """
    name, network = next((name, n) for name, (kind, n) in NETWORKS.items() if kind is type(config))
    if history == 1 and isinstance(config, CatformerConfig | CoBERLConfig):
        raise ValueError(f"a {name} is a transformer over time: set history to 2 or more, not 1")
    if history == 1 and getattr(config, "temporal_position_encoding", False):
        raise ValueError("there are no temporal positions in one observation: set history to more")
    return network(observation_shape, history, config)
