"""Conservative Q-learning with continuous actions, as the paper's agents were trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.data import Bounded
from torchrl.modules import set_recurrent_mode
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import CQLLoss, distance_loss

from torchrl_tit.modules.action_specs import check_bounds
from torchrl_tit.modules.many_actions import ManyActions
from torchrl_tit.objectives.cql_terms import CriticBatch, PolicySamples
from torchrl_tit.objectives.pairs import encode_pairs, get_dist
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Count, Positive, Real, Weight

OverCritics = Literal["mean", "sum"]
Reduction = Literal["none", "mean", "sum"]
Distance = Literal["l1", "l2", "smooth_l1"]


class ContinuousCQLLoss(CQLLoss):
    """Replaces TorchRL's `CQLLoss`, whose formulas differ from those of the paper's agents.

    Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning", arXiv 2006.04779,
    equation 4 (CQL(H)) and appendix F, as in d3rlpy 1.1.1, which arXiv 2212.14538 trained with.
    With m samples of each kind (uniform, policy at s, policy at s'), 3m in all, the loss of one
    critic has two terms::

        loss_qvalue  mean over s of (Q(s, a) - r - gamma min_i Q_i'(s', tanh(mean(s'))))^2
        loss_cql     w * mean over s of [logsumexp_j (Q(s, a_j) - log p(a_j)) - Q(s, a)]

    The squared errors are summed over the critics, the conservative terms averaged (or summed, see
    ``over_critics``). The actor minimises the mean of ``alpha log p(a) - min_i Q_i(s, a)``, and the
    temperature that of ``-alpha (log p(a) + target_entropy)`` with ``alpha = exp(log_alpha)``.

    `CQLLoss` of TorchRL 0.14.1 takes a separate logsumexp over 3 values for each of the m samples,
    evaluates the actions sampled at s' in s' instead of in s, samples the action of the target,
    requires that critics read the same entries as the actor, and runs the actor on m copies of each
    state. Here the actor runs once per state, its distribution is sampled m times, and the modules
    of a critic that do not read the action run once per state.

    A batch is single transitions [B], or slices [N, T] of consecutive ones with "is_init", as
    :class:`~torchrl_tit.datasets.HistoryStorage` makes them: the loss is the same mean over
    transitions, and backbones encode each frame of a slice once. In either case, the actor encodes
    the frames that s and s' share once, see :func:`~torchrl_tit.objectives.encode_pairs`.

    Optimize the terms one after the other, in this order, on the samples of one pass:
    :meth:`alpha_loss`, :meth:`critic_losses`, :meth:`actor_loss`. Each then sees the weights that
    the previous optimizers have updated. ``forward`` computes all terms at once.

    Args:
        actor_network: policy whose distribution has a ``deterministic_sample``, such as that of
            :func:`~torchrl_tit.modules.make_squashed_actor`.
        qvalue_network: reads any keys (those under "next" for the target) and the action, and
            writes "state_action_value", float [..., 1]. Either two critics, which keep their
            initial weights, or one, which TorchRL duplicates and reinitialises.
        action_spec: bounds of an action, a ``Bounded`` spec of shape [A].
        min_q_weight: weight w of the conservative term.
        num_random: number m of samples of each kind.
        over_critics: whether the conservative term is the mean over the critics, as in d3rlpy
            1.1.1, or their sum, as in d3rlpy since 2.5.
        alpha_init: initial temperature.
        target_entropy: entropy that the temperature aims for; "auto" is minus the number of entries
            of an action.
        loss_function: distance to the target; "l2" is the square.
        reduction: how to reduce the losses of a batch; "none" leaves one of each state. None is
            "mean".
        deactivate_vmap: whether to run the critics one after the other, for networks that vmap
            does not support.

    Raises:
        ValueError: if the actions have no finite bounds, or a setting is invalid.

    Example:
        >>> from torchrl_tit.modules import make_squashed_actor
        >>> from torchrl.modules import MLP, ValueOperator
        >>> spec = Bounded(-1, 1, shape=(3,))
        >>> q = ValueOperator(MLP(11 + 3, 1), in_keys=["observation", "action"])
        >>> actor = make_squashed_actor(11, spec, in_key="observation")
        >>> loss = ContinuousCQLLoss(actor, q, action_spec=spec, min_q_weight=5.0)
        >>> loss.make_value_estimator(gamma=0.99)
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 11),
        ...         "action": torch.rand(8, 3),
        ...         "next": {
        ...             "observation": torch.randn(8, 11),
        ...             "reward": torch.ones(8, 1),
        ...             "terminated": torch.zeros(8, 1, dtype=torch.bool),
        ...             "done": torch.zeros(8, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     [8],
        ... )
        >>> sorted(loss(batch).keys())
        ['alpha', 'entropy', 'loss_actor', 'loss_alpha', 'loss_cql', 'loss_qvalue']
    """

    out_keys = ("loss_actor", "loss_qvalue", "loss_cql", "loss_alpha", "alpha", "entropy")

    @checked_arguments
    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        *,
        action_spec: Bounded,
        min_q_weight: Weight = 5.0,
        num_random: Count = 10,
        over_critics: OverCritics = "mean",
        alpha_init: Positive = 1.0,
        target_entropy: Real | Literal["auto"] = "auto",
        loss_function: Distance = "l2",
        reduction: Reduction | None = "mean",
        deactivate_vmap: bool = False,
    ) -> None:
        if not isinstance(action_spec, Bounded) or action_spec.ndim != 1:
            raise ValueError(
                f"action_spec must be a Bounded spec of one dimension, not {action_spec}: samples "
                "are drawn uniformly between the bounds"
            )
        check_bounds(action_spec, "no uniform samples")
        action_key = actor_network.dist_sample_keys[0]
        super().__init__(
            actor_network,
            [ManyActions(critic, action_key) for critic in qvalue_network]
            if isinstance(qvalue_network, Sequence)
            else ManyActions(qvalue_network, action_key),
            loss_function=loss_function,
            alpha_init=alpha_init,
            action_spec=action_spec,
            target_entropy=target_entropy,
            min_q_weight=min_q_weight,
            num_random=num_random,
            deactivate_vmap=deactivate_vmap,
        )
        self.reduction = reduction or "mean"
        self._action_key = action_key
        self.over_critics = over_critics
        self.register_buffer("_low", action_spec.space.low.clone())
        self.register_buffer("_high", action_spec.space.high.clone())

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the entries that the loss reads, in the order of positional arguments."""
        action, *outcome = (
            self.tensor_keys.action,
            self.tensor_keys.reward,
            self.tensor_keys.terminated,
            self.tensor_keys.done,
        )
        read = dict.fromkeys([*self.actor_network.in_keys, *self.qvalue_network.in_keys])
        state = [key for key in read if key != action]
        return [*state, action, *(unravel_key(("next", key)) for key in [*state, *outcome])]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes all terms of a batch [*B].

        Writes each state's squared error, float [*B], the larger of the critics', into the batch:
        "td_error", from which prioritized replay buffers compute priorities.

        Returns:
            "loss_actor", "loss_qvalue", "loss_cql" (weighted) and "loss_alpha", float [], or [*B]
            without a reduction; "alpha" (the temperature) and "entropy" (of the policy, estimated),
            float [].
        """
        batch_dims = tensordict.get(self.tensor_keys.action).ndim - 1
        if tensordict.ndim > batch_dims:  # dispatch takes all that the entries have in common
            tensordict.auto_batch_size_(batch_dims)
        samples = self.sample_policy(tensordict)
        loss_qvalue, loss_cql, td_error = self._critic_terms(tensordict, samples)
        tensordict.set(self.tensor_keys.priority, td_error.amax(0))
        return TensorDict(
            {
                "loss_actor": self.actor_loss(tensordict, samples)[0],
                "loss_qvalue": loss_qvalue,
                "loss_cql": loss_cql,
                "loss_alpha": self.alpha_loss(samples, tensordict),
                "alpha": self._alpha,
                "entropy": -samples.log_prob.detach().mean(),
            }
        )

    def sample_policy(self, tensordict: TensorDictBase) -> PolicySamples:
        """Runs the actor once at s and once at s', and samples what the terms need.

        Frames that s and s' share are encoded once (:func:`~torchrl_tit.objectives.encode_pairs`).

        Args:
            tensordict: a batch [*B].
        """
        network = self.actor_network
        with (
            self.actor_network_params.to_module(network, preserve_module_state=False),
            set_recurrent_mode(True),
        ):
            here, there = encode_pairs(network, tensordict)
            dist = get_dist(network, here)
            with torch.no_grad():
                next_dist = get_dist(network, there)
        action, log_prob = rsample_and_log_prob(dist)
        with torch.no_grad():
            shape = torch.Size([self.num_random])
            drawn = [rsample_and_log_prob(d, shape) for d in (dist, next_dist)]
            actions = torch.cat([a for a, _ in drawn]).movedim(0, -2)  # [*B, 2m, A]
            log_probs = torch.cat([p for _, p in drawn]).movedim(0, -1)  # [*B, 2m]
            next_action = next_dist.deterministic_sample
        return PolicySamples(action, log_prob, actions, log_probs, next_action)

    def alpha_loss(
        self, samples: PolicySamples, tensordict: TensorDictBase | None = None
    ) -> Tensor:
        """The temperature's loss, float [].

        Args:
            samples: from :meth:`sample_policy`.
            tensordict: the batch, which can have a mask (see TorchRL's `loss_mask_key`).
        """
        excess = samples.log_prob.detach() + self.target_entropy
        return self._reduce_loss(-self.log_alpha.exp() * excess, tensordict=tensordict)

    def critic_losses(
        self, tensordict: TensorDictBase, samples: PolicySamples | None = None
    ) -> tuple[Tensor, Tensor]:
        """The critics' squared error and weighted conservative term, float [] each.

        Args:
            tensordict: a batch [*B].
            samples: from :meth:`sample_policy`; sampled here if not given.
        """
        loss_qvalue, loss_cql, _ = self._critic_terms(tensordict, samples)
        return loss_qvalue, loss_cql

    def critic_gradients(
        self, tensordict: TensorDictBase, samples: PolicySamples, chunk_size: int
    ) -> tuple[Tensor, Tensor]:
        """Adds the gradients of the sum of :meth:`critic_losses` to the critics' weights.

        Runs forward and backward on ``chunk_size`` states at a time. On a CPU this takes about a
        fifth less time than the whole batch at once, because the backward pass finds the
        activations of the forward pass still in the cache.

        Args:
            tensordict: a batch [*B].
            samples: from :meth:`sample_policy`.
            chunk_size: number of states at a time, each with its 3m + 1 actions; whole slices of
                states if the batch is [N, T].

        Returns:
            The values of :meth:`critic_losses`, detached; without a reduction, their sums.
        """
        batch = self._critic_batch(tensordict, samples)
        each = self._reduce_loss(torch.ones_like(batch.target), tensordict, reduction="sum")
        divisor = each.clamp_min(1) if self.reduction == "mean" else 1
        losses = []
        for critic in self._critics():
            with (
                critic.to_module(self.qvalue_network, preserve_module_state=False),
                set_recurrent_mode(True),
            ):
                for chunk in batch.split(chunk_size):
                    outputs = self.qvalue_network(chunk.inputs.copy())
                    values = outputs.get(self.tensor_keys.state_action_value).squeeze(-1)
                    loss_qvalue, loss_cql = (
                        self._reduce_loss(loss, chunk.inputs, reduction="sum") / divisor
                        for loss in self._losses(values, chunk)
                    )
                    (loss_qvalue + loss_cql).backward()
                    losses.append(torch.stack([loss_qvalue, loss_cql]).detach())
        loss_qvalue, loss_cql = torch.stack(losses).sum(dim=0).unbind()
        return loss_qvalue, loss_cql

    def q_loss(
        self, tensordict: TensorDictBase, samples: PolicySamples | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """The critics' squared error alone; call :meth:`critic_losses` if you need both.

        Returns:
            The loss, and "td_error", the squared error of each critic in each state, float
            [critics, *B].
        """
        loss_qvalue, _, td_error = self._critic_terms(tensordict, samples)
        return loss_qvalue, {"td_error": td_error}

    def cql_loss(
        self, tensordict: TensorDictBase, samples: PolicySamples | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """The weighted conservative term alone; call :meth:`critic_losses` if you need both."""
        return self.critic_losses(tensordict, samples)[1], {}

    def actor_loss(
        self, tensordict: TensorDictBase, samples: PolicySamples | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """The actor's loss, float []; the critics get no gradient.

        Args:
            tensordict: a batch [*B].
            samples: from :meth:`sample_policy`; sampled here if not given.

        Returns:
            The loss, and the actions' log-probability, float [*B], under
            ``tensor_keys.log_prob``.
        """
        samples = samples or self.sample_policy(tensordict)
        inputs = self._inputs(tensordict, samples.action.unsqueeze(-2))
        values = self._values(inputs, self.qvalue_network_params.detach())  # [critics, *B, 1]
        value = values.squeeze(-1).amin(0)  # [*B]
        alpha = self.log_alpha.detach().exp()
        loss = self._reduce_loss(alpha * samples.log_prob - value, tensordict)
        return loss, {self.tensor_keys.log_prob: samples.log_prob.detach()}

    def _critic_terms(
        self, tensordict: TensorDictBase, samples: PolicySamples | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The losses of :meth:`critic_losses`, and the squared errors, float [critics, *B]."""
        batch = self._critic_batch(tensordict, samples or self.sample_policy(tensordict))
        with set_recurrent_mode(True):
            values = self._values(batch.inputs, self.qvalue_network_params)
        errors, gaps = self._losses(values, batch)
        td_error = (values[..., -1].detach() - batch.target).square()
        return self._reduce_loss(errors, tensordict), self._reduce_loss(gaps, tensordict), td_error

    def _critic_batch(self, tensordict: TensorDictBase, samples: PolicySamples) -> CriticBatch:
        """Adds uniform samples to those of the policy, and computes the target."""
        action = tensordict.get(self.tensor_keys.action)
        *states, size = action.shape
        width = self._high - self._low
        uniform = self._low + width * torch.rand(
            *states, self.num_random, size, dtype=action.dtype, device=action.device
        )
        log_uniform = -width.log().sum().expand(*states, self.num_random)
        actions = torch.cat([uniform, samples.actions, action.unsqueeze(-2)], dim=-2)
        return CriticBatch(
            inputs=self._inputs(tensordict, actions),
            log_density=torch.cat([log_uniform, samples.log_probs], dim=-1),
            target=self._target(tensordict, samples.next_action),
        )

    def _target(self, tensordict: TensorDictBase, next_action: Tensor) -> Tensor:
        """Target of the critics, without gradient; float [*B]."""
        with torch.no_grad(), set_recurrent_mode(True):
            inputs = self._inputs(tensordict["next"], next_action.unsqueeze(-2))
            values = self._values(inputs, self.target_qvalue_network_params)  # [critics, *B, 1]
            outcome = tensordict["next"].select(
                self.tensor_keys.reward, self.tensor_keys.terminated, self.tensor_keys.done
            )
            outcome.set(self.value_estimator.tensor_keys.value, values.amin(0))
            batch = TensorDict({"next": outcome}, tensordict.batch_size)
            return self.value_estimator.value_estimate(batch).squeeze(-1)

    def _inputs(self, tensordict: TensorDictBase, actions: Tensor) -> TensorDictBase:
        """The critics' inputs: each state, with m actions, [*B, m, A], and its mask, if any."""
        keys = {*self.qvalue_network.in_keys, *self._loss_mask_keys()} - {self._action_key}
        return tensordict.select(*keys, strict=False).set(self._action_key, actions)

    def _values(self, inputs: TensorDictBase, params: TensorDictBase) -> Tensor:
        """Values of m actions in each state by all critics; [critics, *B, m]."""
        outputs = self._vmap_qvalue_networkN0(inputs, params)
        return outputs.get(self.tensor_keys.state_action_value).squeeze(-1)

    def _losses(self, values: Tensor, batch: CriticBatch) -> tuple[Tensor, Tensor]:
        """The two losses of some states of a batch, for one critic or all of them; float [*b] each.

        Args:
            values: the actions' values, float [*b, 3m + 1] or [critics, *b, 3m + 1].
            batch: these states, [*b].
        """
        value = values[..., -1]  # of the action taken; [*b] or [critics, *b]
        errors = distance_loss(value, batch.target.expand_as(value), self.loss_function)
        soft_maximum = torch.logsumexp(values[..., :-1] - batch.log_density, dim=-1)
        shape = batch.target.shape
        errors, gaps = (x.reshape(-1, *shape).sum(0) for x in (errors, soft_maximum - value))
        if self.over_critics == "mean":
            gaps = gaps / self.num_qvalue_nets
        return errors, self.min_q_weight * gaps

    def _critics(self) -> list[TensorDictBase]:
        """The weights of each critic, as leaves whose gradients are views of the stacked ones."""
        params = self.qvalue_network_params
        critics = params.data.unbind(0)
        for key, stacked in params.items(True, True):
            if not stacked.requires_grad:
                continue
            if stacked.grad is None:
                stacked.grad = torch.zeros_like(stacked)
            for critic, gradient in zip(critics, stacked.grad.unbind(0), strict=True):
                critic.get(key).requires_grad_().grad = gradient
        return list(critics)
