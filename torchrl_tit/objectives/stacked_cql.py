"""Several losses of continuous CQL side by side, such as one for each seed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn

from torchrl_tit.objectives.cql import ContinuousCQLLoss
from torchrl_tit.objectives.cql_terms import CQLWeights, PolicySamples


class StackedCQLLoss(nn.Module):
    """N of :class:`ContinuousCQLLoss` as one, each with its own weights, batch and random numbers.

    A GPU takes longer to launch the kernels of small networks than to run them, and N losses as one
    launch as many as one loss. The weights are stacked, [N, ...], and ``torch.vmap`` runs the
    methods over them. An optimizer that works entry by entry, such as Adam, steps stacked weights
    as N of them would step one loss each.

    The N losses stay in use: their weights become views of the stacked ones. What is stepped here
    is stepped there, their policies act, and their ``load_state_dict`` reaches the stacked weights.

    Args:
        losses: N losses, built alike.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.modules import MLP, ValueOperator
        >>> from torchrl_tit.modules import make_squashed_actor
        >>> spec = Bounded(-1, 1, shape=(3,))
        >>> def make_loss():
        ...     q = ValueOperator(MLP(11 + 3, 1), in_keys=["observation", "action"])
        ...     actor = make_squashed_actor(11, spec, in_key="observation")
        ...     return ContinuousCQLLoss(actor, q, action_spec=spec)
        >>> loss = StackedCQLLoss([make_loss() for _ in range(5)])
        >>> state = {"observation": torch.randn(5, 8, 11)}
        >>> samples = loss.sample_policy(TensorDict({**state, "next": state}, [5, 8]))
        >>> samples.action.shape, loss.alpha_loss(samples).shape
        (torch.Size([5, 8, 3]), torch.Size([5]))
    """

    def __init__(self, losses: Sequence[ContinuousCQLLoss]) -> None:
        super().__init__()
        # Where SoftUpdate comes later, or not at all, asking for the targets would warn of that.
        parts = [dict(loss.named_children()) for loss in losses]
        for name in ("actor_network_params", "qvalue_network_params"):
            setattr(self, name, TensorDictParams(_stack([part[name] for part in parts])))
        targets = _stack([part["target_qvalue_network_params"] for part in parts])
        self.target_qvalue_network_params = TensorDictParams(targets, no_convert=True)
        self.log_alpha = nn.Parameter(torch.stack([loss.log_alpha.detach() for loss in losses]))
        for loss, log_alpha in zip(losses, self.log_alpha.data, strict=True):
            loss.log_alpha.data = log_alpha
        one = losses[0]
        self._draw = one.draw  # of any batch shape
        vmap = partial(torch.vmap, randomness="different")
        self._run_policy, self._alpha_loss = vmap(one.run_policy), vmap(one.alpha_loss)
        self._critic_losses, self._actor_loss = vmap(one.critic_losses), vmap(one.actor_loss)

    def sample_policy(self, tensordict: TensorDictBase) -> PolicySamples:
        """Runs the actors and draws what the terms need.

        Args:
            tensordict: a batch for each loss, [N, B].

        Returns:
            What :meth:`ContinuousCQLLoss.sample_policy` does, with a dimension N before the others.
        """
        return self._draw(*self._run_policy(tensordict, CQLWeights.of(self)))

    def alpha_loss(self, samples: PolicySamples) -> Tensor:
        """The temperatures' losses, float [N]."""
        return self._alpha_loss(samples, CQLWeights.of(self))

    def critic_losses(
        self, tensordict: TensorDictBase, samples: PolicySamples
    ) -> tuple[Tensor, Tensor]:
        """The critics' squared errors and weighted conservative terms, float [N] each.

        Args:
            tensordict: a batch for each loss, [N, B].
            samples: of :meth:`sample_policy`.
        """
        return self._critic_losses(tensordict, samples, CQLWeights.of(self))

    def actor_loss(
        self, tensordict: TensorDictBase, samples: PolicySamples
    ) -> tuple[Tensor, dict[str, Any]]:
        """The actors' losses, float [N], through critics that get no gradient.

        Args:
            tensordict: a batch for each loss, [N, B].
            samples: of :meth:`sample_policy`.
        """
        return self._actor_loss(tensordict, samples, CQLWeights.of(self))

    @torch.no_grad()
    def update_targets(self, tau: float) -> None:
        """Moves the delayed critics towards the critics, by a share ``tau`` of the way."""
        weights = CQLWeights.of(self)
        weights.target_critics.lerp_(weights.critics, tau)


def _stack(params: Sequence[Any]) -> TensorDictBase:
    """Stacks weights, [N, ...], and turns them into views of the stack."""
    stacked = TensorDict.stack([one.data for one in params])
    for one, views in zip(params, stacked.unbind(0), strict=True):
        for key, weight in one.items(True, True):
            weight.data = views.get(key)
    return stacked
