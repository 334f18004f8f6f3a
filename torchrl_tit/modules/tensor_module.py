"""TensorDict's modules, without their search for pandas at each output."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import ValueOperator


class TensorModule(TensorDictModule):
    """A :class:`~tensordict.nn.TensorDictModule` that writes tensors as they are.

    TensorDict 0.14 checks whether each output is a data frame, and therefore whether pandas is
    installed. This searches all package folders, which takes 0.1 ms, at every call of a module that
    is not compiled (docs/upstream/tensordict.md).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> double = TensorModule(lambda x: 2 * x, in_keys=["x"], out_keys=["y"])
        >>> double(TensorDict(x=torch.ones(2), batch_size=[2]))["y"]
        tensor([2., 2.])
    """

    def _write_to_tensordict(
        self,
        tensordict: TensorDictBase,
        tensors: Sequence[Any],
        tensordict_out: TensorDictBase | None = None,
        out_keys: Iterable[NestedKey] | None = None,
    ) -> TensorDictBase:
        keys = list(self.out_keys_source if out_keys is None else out_keys)
        out = tensordict if tensordict_out is None and self.inplace is True else tensordict_out
        are_tensors = all(isinstance(tensor, Tensor) for tensor in tensors)
        if out is None or len(keys) != len(tensors) or not are_tensors:
            return super()._write_to_tensordict(tensordict, tensors, tensordict_out, keys)
        for key, tensor in zip(keys, tensors, strict=True):
            if key != "_":
                out.set(key, tensor)
        return out


class TensorValue(TensorModule, ValueOperator):
    """A :class:`~torchrl.modules.ValueOperator` that writes tensors as they are."""
