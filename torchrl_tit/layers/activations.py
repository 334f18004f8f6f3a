"""Activation functions by the names that settings use."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import get_args

from torch import nn

from torchrl_tit.settings import Activation

_ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "gelu": nn.GELU,
    "gelu_tanh": partial(nn.GELU, approximate="tanh"),
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


def make_activation(name: Activation) -> nn.Module:
    """Builds an activation function from its name.

    Args:
        name: one of ``"gelu"`` (the exact one, with erf), ``"gelu_tanh"`` (its approximation in
            GPT-2), ``"relu"``, ``"silu"``, ``"tanh"``.

    Returns:
        A parameterless module, elementwise on any shape.

    Raises:
        ValueError: if the name is unknown.

    Example:
        >>> make_activation("relu")
        ReLU()
    """
    if name not in _ACTIVATIONS:
        raise ValueError(f"unknown activation {name!r}: choose one of {get_args(Activation)}")
    return _ACTIVATIONS[name]()
