"""One gradient step of conservative Q-learning with continuous actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tit.objectives import ContinuousCQLLoss, PolicySamples, StackedCQLLoss

from ..compilation import compile_and_time
from ..finite import check_finite


class CQLUpdate:
    """Steps temperature, critics, actor and targets, in this order, on one batch.

    The actor runs once for all of them; the actor's loss sees critics and temperature after their
    steps, as in d3rlpy.

    Args:
        loss: the losses, with all weights; of one agent, or of several stacked.
        temperature_optimizer: of the temperature.
        critic_optimizer: of the critics.
        actor_optimizer: of the actor.
        update_targets: moves the target critics.
        states_at_once: states on which the critics' losses pass forth and back at a time; all
            where not given, as it must be for stacked losses. A few are faster on a CPU.
        options: of ``torch.compile``; without any nothing is compiled. With ``states_at_once``
            the policy alone is: what the critics do is matrix products.
    """

    TERMS: ClassVar[list[str]] = [
        "loss_alpha",
        "loss_qvalue",
        "loss_cql",
        "loss_actor",
        "alpha",
        "entropy",
    ]
    """What a gradient step gives; the losses in the order of the steps, so that the first that is
    not finite is the one to blame."""

    def __init__(
        self,
        loss: ContinuousCQLLoss | StackedCQLLoss,
        temperature_optimizer: torch.optim.Optimizer,
        critic_optimizer: torch.optim.Optimizer,
        actor_optimizer: torch.optim.Optimizer,
        update_targets: Callable[[], None],
        *,
        states_at_once: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.loss = loss
        self.temperature_optimizer = temperature_optimizer
        self.critic_optimizer = critic_optimizer
        self.actor_optimizer = actor_optimizer
        self.update_targets = update_targets
        self.states_at_once = states_at_once
        self.sample_policy, self.critic_losses = loss.sample_policy, loss.critic_losses
        self.actor_loss = loss.actor_loss
        if options is not None:
            self.sample_policy = compile_and_time(loss.sample_policy, options, "the policy")
        if options is not None and states_at_once is None:
            self.critic_losses = compile_and_time(loss.critic_losses, options, "the critics' loss")
            self.actor_loss = compile_and_time(loss.actor_loss, options, "the actor's loss")

    def __call__(self, batch: TensorDictBase, step: int, saved_step: int) -> Tensor:
        """Takes a step.

        Args:
            batch: transitions [B]; of each of N stacked losses, [N, B].
            step: gradient steps before this one, for messages.
            saved_step: step of the newest checkpoint, for messages.

        Returns:
            ``TERMS``, float [terms] or [N, terms].

        Raises:
            FloatingPointError: if a term is not finite, on a CPU, of losses that are not stacked.
        """
        torch.compiler.cudagraph_mark_step_begin()  # graphs may write over the last step's tensors
        samples = self.sample_policy(batch)
        loss_alpha = self.loss.alpha_loss(samples)
        _descend(loss_alpha, self.temperature_optimizer)
        self.critic_optimizer.zero_grad()
        loss_qvalue, loss_cql = self._critic_gradients(batch, samples)
        self.critic_optimizer.step()
        loss_actor, _ = self.actor_loss(batch, samples)
        _descend(loss_actor, self.actor_optimizer)
        self.update_targets()
        terms = torch.stack(
            [
                loss_alpha.detach(),
                loss_qvalue,
                loss_cql,
                loss_actor.detach(),
                self.loss.log_alpha.detach().exp(),
                -samples.log_prob.detach().mean(dim=-1),
            ],
            dim=-1,
        )
        # A GPU would be waited for, and stacked losses bear no names: there the run looks, less
        # often.
        if terms.device.type == "cpu" and terms.ndim == 1:
            check_finite(self.TERMS, terms, step, saved_step)
        return terms

    def _critic_gradients(
        self, batch: TensorDictBase, samples: PolicySamples
    ) -> tuple[Tensor, Tensor]:
        """Adds them to the critics' weights; returns the squared error and the other term."""
        if self.states_at_once is not None:
            assert isinstance(self.loss, ContinuousCQLLoss)
            return self.loss.critic_gradients(batch, samples, self.states_at_once)
        loss_qvalue, loss_cql = self.critic_losses(batch, samples)
        (loss_qvalue + loss_cql).sum().backward()
        return loss_qvalue.detach(), loss_cql.detach()


def _descend(loss: Tensor, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    loss.sum().backward()  # of stacked losses, each has weights of its own
    optimizer.step()
