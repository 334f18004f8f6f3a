"""Conservative Q-learning with discrete actions and a target network."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import DiscreteCQLLoss

from torchrl_tit.settings.arguments import checked_arguments


class DelayedDiscreteCQLLoss(DiscreteCQLLoss):
    """Replaces TorchRL's `DiscreteCQLLoss`, which ignores its target network.

    Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning", arXiv 2006.04779,
    equation 4 (CQL(H)) over the values of all actions::

        loss_qvalue  mean over s of (Q(s, a) - r - gamma max_b Q'(s', b))^2 / 2
        loss_cql     mean over s of [logsumexp_b Q(s, b) - Q(s, a)]

    `DiscreteCQLLoss` of TorchRL 0.14.1 has target parameters Q', but passes them to its value
    estimator as ``params``, which the estimator ignores, so its target is computed with Q. In
    addition to what `DiscreteCQLLoss` writes into the batch, this loss writes the value at s'.

    A batch is single transitions [B], or slices [N, T] of consecutive ones with "is_init", where a
    backbone encodes each frame once. In single transitions, s and s' share no work, because they
    are evaluated with different weights.

    Args:
        value_network: writes "action_value", float [..., n], and "chosen_action_value", float
            [..., 1].
        loss_function: distance to the target; "l2" is the square.
        reduction: how to reduce the losses of a batch; None is "mean".
        **settings: passed to `DiscreteCQLLoss`: ``action_space``.

    Raises:
        ValueError: if a setting is invalid.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch import nn
        >>> from torchrl.modules import QValueActor
        >>> actor = QValueActor(nn.Linear(4, 2), action_space="categorical")
        >>> loss = DelayedDiscreteCQLLoss(actor, action_space="categorical")
        >>> loss.make_value_estimator(gamma=0.99)
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 4),
        ...         "action": torch.randint(2, (8,)),
        ...         "next": {
        ...             "observation": torch.randn(8, 4),
        ...             "reward": torch.ones(8, 1),
        ...             "terminated": torch.zeros(8, 1, dtype=torch.bool),
        ...             "done": torch.zeros(8, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     [8],
        ... )
        >>> losses = loss(batch)
        >>> (losses["loss_qvalue"] + losses["loss_cql"]).backward()
    """

    out_keys = ("loss_qvalue", "loss_cql")

    @checked_arguments
    def __init__(
        self,
        value_network: Any,
        *,
        loss_function: Literal["l1", "l2", "smooth_l1"] = "l2",
        reduction: Literal["none", "mean", "sum"] | None = "mean",
        **settings: Any,
    ) -> None:
        super().__init__(
            value_network,
            delay_value=True,
            loss_function=loss_function,
            reduction=reduction,
            **settings,
        )

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Chooses how targets are computed; see TorchRL's `LossModule.make_value_estimator`."""
        super().make_value_estimator(value_type, **hyperparams)
        self.value_estimator.value_network = None  # it would use the trained weights

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The squared error of a batch [*B], float [], and mean values to log."""
        next_state = tensordict["next"].select(*self.value_network.in_keys, strict=False)
        params = self._cached_detached_target_value_params
        with (
            torch.no_grad(),
            params.to_module(self.value_network, preserve_module_state=False),
        ):
            value = self.value_network(next_state).get(self.tensor_keys.value)
        tensordict.set(("next", self.tensor_keys.value), value)
        return super().value_loss(tensordict)
