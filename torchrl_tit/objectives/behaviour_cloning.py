"""Behaviour cloning with any distribution of actions."""

from __future__ import annotations

from typing import Literal

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.objectives import BCLoss

from torchrl_tit.settings.arguments import checked_arguments


class LikelihoodBCLoss(BCLoss):
    """Replaces TorchRL's `BCLoss`, which fails for policies of discrete actions.

    The negative log-likelihood of the actions, a mean over the batch::

        loss_bc  -log pi(a | s)

    `BCLoss` of TorchRL 0.14.1 passes the sampled action, instead of the logits, to the
    cross-entropy if actions are integers; if they are not, it runs a stochastic policy twice. This
    loss gets the policy's distribution in one pass.

    Args:
        actor_network: a policy with ``get_dist``, such as a `ProbabilisticActor`.
        reduction: how to reduce the losses of a batch.

    Raises:
        ValueError: if there is no such ``reduction``, or the policy has no ``get_dist``.

    Example:
        >>> import torch
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit.modules import make_actor
        >>> loss = LikelihoodBCLoss(make_actor(8, Categorical(3)))
        >>> batch = {"features": torch.randn(16, 8), "action": torch.randint(3, (16,))}
        >>> loss(TensorDict(batch, [16]))["loss_bc"].shape
        torch.Size([])
    """

    target_actor_network_params: TensorDictParams

    @checked_arguments
    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        reduction: Literal["none", "mean", "sum"] = "mean",
    ) -> None:
        if not hasattr(actor_network, "get_dist"):
            raise ValueError(f"actor_network must be a policy with get_dist, not {actor_network!r}")
        super().__init__(actor_network, reduction=reduction)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss of a batch [*B], which is left unchanged."""
        action = tensordict.get(self.tensor_keys.action)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(tensordict.copy())
        loss = self._reduce_loss(-dist.log_prob(action), tensordict=tensordict)
        return TensorDict({"loss_bc": loss})
