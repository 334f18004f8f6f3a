"""Behavior cloning with any distribution of actions."""

from __future__ import annotations

from typing import Literal

from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, dispatch
from torch import nn
from torchrl.modules import Actor, Delta, TanhDelta
from torchrl.objectives import BCLoss

from torchrl_tit.settings.checks import checked_arguments


class LikelihoodBCLoss(BCLoss):
    """Replaces TorchRL's `BCLoss`, which fails for policies of discrete actions.

    The negative log-likelihood of the actions, a mean over the batch::

        loss_bc  -log pi(a | s)

    `BCLoss` of TorchRL 0.14.1 passes the sampled action, instead of the logits, to the
    cross-entropy if actions are integers; if they are not, it runs a stochastic policy twice. This
    loss gets the policy's distribution in one pass. As in `BCLoss`, ``set_keys(pad_mask=...)``
    names an entry, bool [*B], that is True at padding, which then does not count.

    Args:
        actor_network: a stochastic policy with ``get_dist``, such as a `ProbabilisticActor`.
        reduction: how to reduce the losses of a batch; None, as in TorchRL, is "mean".

    Raises:
        ValueError: if there is no such ``reduction``, or the policy has no ``get_dist`` or is
            deterministic; in ``forward``, if actions do not have the shape of the policy's.
        KeyError: in ``forward``, if ``pad_mask`` is set and the batch has no such entry.

    Example:
        >>> import torch
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit.modules import make_actor
        >>> loss = LikelihoodBCLoss(make_actor(8, Categorical(3)))
        >>> batch = {"features": torch.randn(16, 8), "action": torch.randint(3, (16,))}
        >>> torch.equal(loss(TensorDict(batch, [16]))["loss_bc"], loss(**batch))
        True
    """

    out_keys = ("loss_bc",)
    target_actor_network_params: TensorDictParams

    @checked_arguments
    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        name = type(actor_network).__name__
        if not hasattr(actor_network, "get_dist"):
            given = name if isinstance(actor_network, nn.Module) else repr(actor_network)
            raise ValueError(f"actor_network must be a policy with get_dist, not {given}")
        if _is_deterministic(actor_network):
            raise ValueError(
                "actor_network must be a stochastic policy, such as a ProbabilisticActor, not the "
                f"deterministic {name}, whose actions have no density: train it with TorchRL's "
                "BCLoss"
            )
        super().__init__(actor_network, reduction=reduction)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the entries that the loss reads, in the order of positional arguments."""
        keys = [*self.actor_network.in_keys, self.tensor_keys.action, self.tensor_keys.pad_mask]
        return [key for key in dict.fromkeys(keys) if key is not None]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss of a batch [*B], which is left unchanged."""
        action, pad_mask = tensordict[self.tensor_keys.action], self.tensor_keys.pad_mask
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(tensordict.copy())
        expected = dist.batch_shape + dist.event_shape
        if action.shape != expected:  # it would be broadcast
            raise ValueError(
                f"{self.tensor_keys.action!r} has the shape {list(action.shape)}, but the policy's "
                f"actions have {list(expected)}: reshape it"
            )
        loss = -dist.log_prob(action)
        loss = loss if pad_mask is None else loss[~tensordict[pad_mask]]
        if self.reduction != "none":
            loss = loss.sum() if self.reduction == "sum" else loss.mean()
        return TensorDict({"loss_bc": loss})


def _is_deterministic(policy: nn.Module) -> bool:
    """Whether a policy gives one action a probability of 1, so that all others have none."""
    kinds = [getattr(module, "distribution_class", None) for module in policy.modules()]
    return isinstance(policy, Actor) or Delta in kinds or TanhDelta in kinds
