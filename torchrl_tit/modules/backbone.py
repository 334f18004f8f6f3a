"""The backbone: a network of this library as a TensorDictModule."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn


class Backbone(TensorDictModule):
    """Reads a history and writes features, for any TorchRL head, loss or collector.

    Put it in front of the heads, once: heads read the features, so the network runs once a step
    while collecting and once a minibatch in the update, however many heads and losses there are.

    Args:
        network: maps a history [..., K, *observation_shape] to features [..., F], or to as many
            tensors as there are ``out_keys`` (policy and value features, say).
        in_keys: one key, nested or not, under which the history stands (see
            :class:`~torchrl_tit.transforms.History`).
        out_keys: one key for each tensor that the network puts out.

    Raises:
        ValueError: if there is not exactly one ``in_key``, or no ``out_key``.
        KeyError: in ``forward``, if there is no history under the key.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> tit = EnhancedTIT(observation_shape=(4,), history=8, features_dim=32)
        >>> backbone = Backbone(tit, in_keys=["history"], out_keys=["features"])
        >>> backbone(TensorDict({"history": torch.randn(5, 8, 4)}, [5]))["features"].shape
        torch.Size([5, 32])
    """

    def __init__(
        self,
        network: nn.Module,
        in_keys: Sequence[NestedKey] = ("history",),
        out_keys: Sequence[NestedKey] = ("features",),
    ) -> None:
        if len(in_keys) != 1 or not out_keys:
            raise ValueError(
                "a backbone reads one history and writes at least one entry of features, not "
                f"in_keys={list(in_keys)} and out_keys={list(out_keys)}"
            )
        super().__init__(network, in_keys=list(in_keys), out_keys=list(out_keys))

    def forward(
        self, tensordict: TensorDictBase, *args: object, **kwargs: object
    ) -> TensorDictBase:
        """Writes the features of the history into the tensordict and returns it."""
        (key,) = self.in_keys
        if isinstance(tensordict, TensorDictBase) and tensordict.get(key, None) is None:
            raise KeyError(
                f"there is no history under {key!r}, only {sorted(map(str, tensordict.keys(True)))}"
                ": add torchrl_tit.History to the environment, or name the key in in_keys"
            )
        return super().forward(tensordict, *args, **kwargs)
