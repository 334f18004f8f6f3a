"""Decision Transformer's loss, which ignores padding and supports discrete actions."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch.nn import functional as F
from torchrl.objectives import DTLoss

from torchrl_tit.settings.checks import checked_arguments


class MaskedDTLoss(DTLoss):
    """TorchRL's `DTLoss`, restricted to the steps that are not padding.

    `DTLoss` includes padding unless its ``loss_mask_key`` is set, as it is here. It has no loss for
    discrete actions; this class adds ``loss_function="cross_entropy"``. The mean is taken over all
    entries of all unmasked actions.

    Args:
        actor_network: reads a batch and replaces "action" with the predicted action of every step:
            see :func:`~torchrl_tit.modules.make_dt_predictor`.
        loss_function: "l2", "l1" or "smooth_l1" between continuous actions [..., K, A], or
            "cross_entropy" between logits and discrete ones, integers [..., K] or one-hot.
        mask_key: key of the mask, bool [..., K], False at padding.
        reduction: how to reduce the losses of the steps; None, as in TorchRL, is "mean".

    Returns:
        In ``forward``, a tensordict with "loss", float [] unless ``reduction`` is "none".

    Raises:
        ValueError: if there is no such ``loss_function`` or ``reduction``.
        KeyError: in ``forward``, if the batch has no mask.
        TypeError: in ``forward``, if the loss function does not suit the actions of the batch.

    Source: "Decision Transformer" (arXiv 2106.01345), section 3.

    Example:
        >>> from torchrl_tit.modules import DTHead, make_dt_predictor
        >>> from torchrl_tit.networks import DecisionTransformer
        >>> network = DecisionTransformer((11,), action_dim=3)
        >>> loss = MaskedDTLoss(make_dt_predictor(network, DTHead(network.features_dim, 3)))
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 20, 11),
        ...         "action": torch.randn(8, 20, 3),
        ...         "return_to_go": torch.ones(8, 20, 1),
        ...         "timestep": torch.arange(20).expand(8, 20),
        ...         "mask": torch.arange(20).expand(8, 20) > 4,
        ...     },
        ...     [8],
        ... )
        >>> loss(batch)["loss"].shape
        torch.Size([])
    """

    @checked_arguments
    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        loss_function: Literal["l2", "l1", "smooth_l1", "cross_entropy"] = "l2",
        mask_key: NestedKey = "mask",
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(actor_network, loss_function=loss_function, reduction=reduction)
        self.loss_mask_key = mask_key

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the entries that the loss reads, in the order of positional arguments."""
        target, mask = self.tensor_keys.action_target, self.loss_mask_key
        return list(dict.fromkeys([*self.actor_network.in_keys, target, mask]))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss of a batch [...], which is left unchanged."""
        if tensordict.get(self.loss_mask_key, None) is None:
            raise KeyError(
                f"the batch has no mask {self.loss_mask_key!r}, only "
                f"{sorted(map(str, tensordict.keys(True, True)))}: store one, bool [..., K] and "
                "False at padding, or name its key in mask_key"
            )
        target = tensordict[self.tensor_keys.action_target]
        discrete = self.loss_function == "cross_entropy"
        if discrete == target.is_floating_point():
            other = "'cross_entropy'" if not discrete else "one of 'l2', 'l1', 'smooth_l1'"
            raise TypeError(
                f"loss_function {self.loss_function!r} does not fit actions of {target.dtype}: "
                f"take {other}"
            )
        if not discrete:
            return super().forward(tensordict)
        tensordict = tensordict.copy()
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            logits = self.actor_network(tensordict).get(self.tensor_keys.action_pred)
        if target.ndim == logits.ndim:  # one-hot
            target = target.to(torch.int8).argmax(-1)
        ignored = ~tensordict[self.loss_mask_key]
        classes = target.long().masked_fill(ignored, -1).flatten()
        loss = F.cross_entropy(
            logits.flatten(0, -2), classes, ignore_index=-1, reduction=self.reduction
        )
        return TensorDict({"loss": loss if loss.ndim == 0 else loss.view(target.shape)})
