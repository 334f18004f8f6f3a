"""Conservative Q-learning: with continuous actions as the paper trained it, and with discrete."""

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
from torchrl.objectives import CQLLoss, DiscreteCQLLoss, distance_loss

from torchrl_tit.modules.action_specs import check_bounds
from torchrl_tit.modules.many_actions import ManyActions
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Count, Positive, Real, Weight

OverCritics = Literal["mean", "sum"]
Reduction = Literal["none", "mean", "sum"]
Distance = Literal["l1", "l2", "smooth_l1"]

_SAMPLES = "policy_samples"
_MARGIN = 0.005
"""Share of an action's range that cloned actions keep away from its bounds."""


class ContinuousCQLLoss(CQLLoss):
    """Replaces TorchRL's `CQLLoss`, whose formulas differ from those of the paper's agents.

    Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning", arXiv 2006.04779,
    equation 4 (CQL(H)) and appendix F, as in d3rlpy 1.1.1, which arXiv 2212.14538 trained with.
    With m samples of each kind (uniform, policy at s, policy at s'), 3m in all, the loss of one
    critic has two terms::

        loss_qvalue  mean over s of (Q(s, a) - r - gamma min_i Q_i'(s', tanh(mean(s'))))^2
        loss_cql     w * mean over s of [logsumexp_j (Q(s, a_j) - log p(a_j)) - Q(s, a)]

    The squared errors are summed over the critics, the conservative terms averaged (or summed, see
    ``over_critics``). The actor minimizes the mean of ``alpha log p(a) - min_i Q_i(s, a)``, and the
    temperature that of ``-alpha (log p(a) + target_entropy)`` with ``alpha = exp(log_alpha)``.

    `CQLLoss` of TorchRL 0.14.1 takes a separate logsumexp over 3 values for each of the m samples,
    evaluates the actions sampled at s' in s' instead of in s, samples the action of the target,
    requires that critics read the same entries as the actor, and runs the actor on m copies of each
    state. Here the actor runs once per state, its distribution is sampled m times, and the modules
    of a critic that do not read the action run once per state.

    A batch is single transitions [B], or slices [N, T] of consecutive ones with "is_init", as
    :class:`~torchrl_tit.datasets.HistoryStorage` makes them: the loss is the same mean over
    transitions, and backbones encode each frame of a slice once.

    ``forward`` computes all terms with the present weights. Its terms are also methods, to step the
    networks one after the other: d3rlpy steps the actor on critics that it has just updated. To
    share one pass of the actor among them, give each the batch that :meth:`sample_policy` returns.

    Args:
        actor_network: policy whose distribution has a ``deterministic_sample``, such as that of
            :func:`~torchrl_tit.modules.make_squashed_actor`.
        qvalue_network: reads any keys (those under "next" for the target) and the action, and
            writes "state_action_value", float [..., 1]. A list of two critics, which keep their
            initial weights, or one module, which TorchRL duplicates and reinitializes.
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
        )
        self.set_keys(action=action_key)
        self.reduction = reduction or "mean"
        self.action_key = action_key
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
        batch_dims = tensordict[self.tensor_keys.action].ndim - 1
        if tensordict.ndim > batch_dims:  # dispatch takes all that the entries have in common
            tensordict.auto_batch_size_(batch_dims)
        batch = self.sample_policy(tensordict)
        critics = self.critic_loss(batch)
        tensordict.set(self.tensor_keys.priority, critics["td_error"].amax(0))
        return TensorDict(
            {
                "loss_actor": self.actor_loss(batch)[0],
                "loss_qvalue": critics["loss_qvalue"],
                "loss_cql": critics["loss_cql"],
                "loss_alpha": self.alpha_loss(batch)[0],
                "alpha": self.log_alpha.detach().exp(),
                "entropy": -batch[_SAMPLES, "log_prob"].detach().mean(),
            }
        )

    def sample_policy(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Runs the actor once at s and once at s', and draws the actions of all terms.

        Args:
            tensordict: a batch [*B].

        Returns:
            The batch with "policy_samples": "action", float [*B, A], and its "log_prob", float
            [*B], drawn at s and differentiable; and, detached, "actions", float [*B, 2m, A], m at
            s and then m at s', their "log_probs", float [*B, 2m], and "next_action", float [*B, A],
            the deterministic one at s'.
        """
        network = self.actor_network
        with (
            self.actor_network_params.to_module(network, preserve_module_state=False),
            set_recurrent_mode(True),
        ):
            dist = network.get_dist(tensordict.select(*network.in_keys, strict=False))
            with torch.no_grad():
                following = tensordict["next"].select(*network.in_keys, strict=False)
                next_dist = network.get_dist(following)
        action, log_prob = rsample_and_log_prob(dist)
        with torch.no_grad():
            shape = torch.Size([self.num_random])
            drawn = [rsample_and_log_prob(d, shape) for d in (dist, next_dist)]
            samples = {
                "action": action,
                "log_prob": log_prob,
                "actions": torch.cat([a for a, _ in drawn]).movedim(0, -2),
                "log_probs": torch.cat([p for _, p in drawn]).movedim(0, -1),
                "next_action": next_dist.deterministic_sample,
            }
        return tensordict.copy().set(_SAMPLES, TensorDict(samples, tensordict.batch_size))

    def alpha_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The temperature's loss of a batch [*B], float []; nothing else gets a gradient."""
        samples = self._samples(tensordict)
        excess = samples["log_prob"].detach() + self.target_entropy
        return self._reduced(-self.log_alpha.exp() * excess), {}

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The critics' terms of a batch [*B]; the actor gets no gradient.

        Returns:
            "loss_qvalue" and "loss_cql" (weighted), float [], and "td_error", the squared error of
            each critic in each state, float [critics, *B].
        """
        samples, action = self._samples(tensordict), tensordict.get(self.tensor_keys.action)
        *states, size = action.shape
        width = self._high - self._low
        uniform = self._low + width * torch.rand(
            *states, self.num_random, size, dtype=action.dtype, device=action.device
        )
        log_uniform = -width.log().sum().expand(*states, self.num_random)
        log_density = torch.cat([log_uniform, samples["log_probs"]], dim=-1)  # [*B, 3m]
        actions = torch.cat([uniform, samples["actions"], action.unsqueeze(-2)], dim=-2)
        values = self._values(tensordict, actions, self.qvalue_network_params)
        value = values[..., -1]  # of the action taken, [critics, *B]
        target = self._target(tensordict, samples["next_action"]).expand_as(value)
        errors = distance_loss(value, target, self.loss_function).sum(0)
        gaps = torch.logsumexp(values[..., :-1] - log_density, dim=-1) - value
        gaps = gaps.mean(0) if self.over_critics == "mean" else gaps.sum(0)
        terms = {
            "loss_qvalue": self._reduced(errors),
            "loss_cql": self._reduced(self.min_q_weight * gaps),
            "td_error": (value.detach() - target).square(),
        }
        return TensorDict(terms)

    def q_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Any]]:
        """The squared error and "td_error" of :meth:`critic_loss`, which computes both terms."""
        terms = self.critic_loss(tensordict)
        return terms["loss_qvalue"], {"td_error": terms["td_error"]}

    def cql_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Any]]:
        """The conservative term of :meth:`critic_loss`, which computes both terms."""
        return self.critic_loss(tensordict)["loss_cql"], {}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Any]]:
        """The actor's loss of a batch [*B], float []; nothing else gets a gradient.

        Returns:
            The loss, and the actions' log-probability, float [*B], under
            ``tensor_keys.log_prob``.
        """
        samples = self._samples(tensordict)
        params = self.qvalue_network_params.detach()
        values = self._values(tensordict, samples["action"].unsqueeze(-2), params)
        value = values.squeeze(-1).amin(0)  # [*B]
        log_prob, alpha = samples["log_prob"], self.log_alpha.detach().exp()
        return self._reduced(alpha * log_prob - value), {
            self.tensor_keys.log_prob: log_prob.detach()
        }

    def actor_bc_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of an actor that clones the data, of a batch [*B], float [].

        TorchRL's, the mean of ``alpha log p(a) - log p(b)`` with the data's actions b, as in the
        code of arXiv 2006.04779. Data sets have many actions at the bounds, which a squashed
        Gaussian reaches only at infinity, so b is kept 0.5% of the range away from them.

        Returns:
            The loss, and the mean of log p(b), float [], under "bc_log_prob".
        """
        batch = tensordict.select(*self.actor_network.in_keys, strict=False)
        margin = _MARGIN * (self._high - self._low)
        action = tensordict.get(self.tensor_keys.action)
        batch.set(self.tensor_keys.action, action.clamp(self._low + margin, self._high - margin))
        with set_recurrent_mode(True):
            return super().actor_bc_loss(batch)

    def _samples(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The policy's samples that a batch has, or new ones."""
        samples = tensordict.get(_SAMPLES, None)
        return self.sample_policy(tensordict)[_SAMPLES] if samples is None else samples

    def _target(self, tensordict: TensorDictBase, next_action: Tensor) -> Tensor:
        """Target of the critics, without gradient; float [*B]."""
        following, keys = tensordict["next"], self.tensor_keys
        with torch.no_grad():
            params = self.target_qvalue_network_params
            values = self._values(following, next_action.unsqueeze(-2), params)
            outcome = following.select(keys.reward, keys.terminated, keys.done)
            outcome.set(self.value_estimator.tensor_keys.value, values.amin(0))
            batch = TensorDict({"next": outcome}, tensordict.batch_size)
            return self.value_estimator.value_estimate(batch).squeeze(-1)

    def _values(
        self, tensordict: TensorDictBase, actions: Tensor, params: TensorDictBase
    ) -> Tensor:
        """Values of m actions in each state, [*B, m, A], by all critics; [critics, *B, m]."""
        network, keys, values = self.qvalue_network, self.tensor_keys, []
        states = tensordict.select(*set(network.in_keys) - {self.action_key}, strict=False)
        # vmap would run both critics at once, but a CPU is faster with two matrix products than
        # with one batched product, and a slice's number of frames depends on the data.
        for critic in params.unbind(0):
            with critic.to_module(network, preserve_module_state=False), set_recurrent_mode(True):
                outputs = network(states.copy().set(self.action_key, actions))
            values.append(outputs.get(keys.state_action_value).squeeze(-1))
        return torch.stack(values)

    def _reduced(self, losses: Tensor) -> Tensor:
        """Reduces the losses of states, float [*B]."""
        return losses if self.reduction == "none" else getattr(losses, self.reduction)()


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
        loss_function: Distance = "l2",
        reduction: Reduction | None = "mean",
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
        params = self.target_value_network_params
        with torch.no_grad(), params.to_module(self.value_network, preserve_module_state=False):
            value = self.value_network(next_state).get(self.tensor_keys.value)
        tensordict.set(("next", self.tensor_keys.value), value)
        return super().value_loss(tensordict)
