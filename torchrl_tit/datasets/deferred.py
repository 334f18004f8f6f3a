"""Tensors whose values are computed when they are used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only


class DeferredTensor(Tensor):
    """A tensor with known shape and dtype, whose values are computed on first use.

    All operations on it return plain tensors. Storages return it if all items are requested but few
    of their entries are read, as by TorchRL's `SliceSampler`.

    Args:
        compute: computes the values, a tensor of this shape, dtype and device.
        shape: the shape.
        dtype: the dtype.
        device: the device.

    Example:
        >>> cpu = torch.device("cpu")
        >>> deferred = DeferredTensor(lambda: torch.ones(2), (2,), torch.float32, cpu)
        >>> deferred.shape, type(deferred + 1)
        (torch.Size([2]), <class 'torch.Tensor'>)
    """

    compute: Callable[[], Tensor]

    @staticmethod
    def __new__(
        cls,
        compute: Callable[[], Tensor],
        shape: Sequence[int],
        dtype: torch.dtype,
        device: torch.device,
    ) -> DeferredTensor:
        """Creates a tensor without memory."""
        made = Tensor._make_wrapper_subclass(cls, tuple(shape), dtype=dtype, device=device)
        made.compute = compute
        return made

    @classmethod
    def __torch_function__(
        cls, func: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Answers calls that need no values, and computes the values for all others."""
        if func in _KNOWN:
            return super().__torch_function__(func, types, args, kwargs)
        return cls.__torch_dispatch__(func, types, args, kwargs)

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]  # PyTorch's annotation lacks cls and func
        cls, func: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Runs an operation on the values."""
        args, kwargs = tree_map_only(cls, lambda x: x.compute(), (args, kwargs or {}))
        return func(*args, **kwargs)


_KNOWN = {
    *(
        getattr(Tensor, name).__get__
        for name in (
            "device",
            "dtype",
            "is_cuda",
            "is_nested",
            "layout",
            "ndim",
            "requires_grad",
            "shape",
        )
    ),
    Tensor.__len__,
    Tensor.dim,
    Tensor.is_floating_point,
    Tensor.is_shared,
    Tensor.numel,
    Tensor.size,
}
