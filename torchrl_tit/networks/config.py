"""What the configurations of all networks share: overriding fields and checking them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

_Config = TypeVar("_Config")


def override_config(
    kind: type[_Config], config: _Config | None, hyperparameters: dict[str, Any]
) -> _Config:
    """Returns the config, by default one of that kind, with hyperparameters replaced.

    Args:
        kind: dataclass of the network's configuration.
        config: the configuration, or None for the defaults.
        hyperparameters: fields that override those of ``config``.

    Raises:
        TypeError: if there is no such field, or ``config`` is that of another network.

    Example:
        >>> from torchrl_tit.networks import MLPConfig
        >>> override_config(MLPConfig, None, {"hidden_dim": 32}).hidden_dim
        32
    """
    if config is None:
        return kind(**hyperparameters)
    if not isinstance(config, kind):
        raise TypeError(f"config is of type {type(config).__name__}: expected {kind.__name__}")
    return replace(config, **hyperparameters)  # type: ignore[type-var]


def check_positive(config: object, *names: str) -> None:
    """Raises ValueError where one of these fields is not a number >= 1."""
    for name in names:
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be >= 1, not {getattr(config, name)}")


def check_probability(config: object, *names: str) -> None:
    """Raises ValueError where one of these fields is not in [0, 1)."""
    for name in names:
        if not 0 <= getattr(config, name) < 1:
            raise ValueError(f"{name} is a probability in [0, 1), not {getattr(config, name)}")
