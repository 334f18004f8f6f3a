"""Parameters in one tensor, so that clipping and the optimizer's step are few operations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn


class FlatParameters:
    """Stores parameters in one tensor, and their gradients in another.

    The parameters keep their values and become views. For a network of small layers, the gradient
    norm, clipping and Adam's step take a third of the time if they run on ``flat`` alone.

    Args:
        parameters: parameters on one device and of one dtype. They must stay there: moving or
            casting a module gives it new memory.

    Example:
        >>> linear = nn.Linear(2, 2)
        >>> flat = FlatParameters(list(linear.parameters())).flat
        >>> flat.shape
        torch.Size([6])
        >>> linear(torch.ones(1, 2)).sum().backward()
        >>> flat.grad
        tensor([1., 1., 1., 1., 1., 1.])
    """

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        values = torch.cat([parameter.detach().flatten() for parameter in parameters])
        gradients = torch.zeros_like(values)
        self.flat = nn.Parameter(values)
        """All values, float [P], with their gradients as ``grad``."""
        self.flat.grad = gradients
        sizes = [parameter.numel() for parameter in parameters]
        views = zip(parameters, values.split(sizes), gradients.split(sizes), strict=True)
        for parameter, value, gradient in views:
            parameter.data = value.view_as(parameter)
            parameter.grad = gradient.view_as(parameter).data  # no view of its base, for autograd
