"""Activation functions by the names that settings use."""

from __future__ import annotations

from torch import nn

from torchrl_tit.settings.encoders import Activation


def make_activation(name: Activation) -> nn.Module:
    """Builds an activation function from its name.

    Args:
        name: one of ``"gelu"`` (the exact one, with erf), ``"gelu_tanh"`` (its approximation in
            GPT-2), ``"relu"``, ``"silu"``, ``"tanh"``.

    Returns:
        A parameterless module, elementwise on any shape.

    Example:
        >>> make_activation("relu")
        ReLU()
    """
    if name == "gelu_tanh":
        return nn.GELU(approximate="tanh")
    return {"gelu": nn.GELU, "relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}[name]()
