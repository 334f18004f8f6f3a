"""Conservative Q-learning with continuous actions, as the paper's agents were trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import CQLLoss, distance_loss

from torchrl_tit.modules.many_actions import ManyActions
from torchrl_tit.objectives.cql_terms import CQLWeights, PolicySamples, Questions
from torchrl_tit.objectives.relu_mlp import ReLUMLP

OverCritics = Literal["mean", "sum"]


class ContinuousCQLLoss(CQLLoss):
    """TorchRL's `CQLLoss` with the formulas of the paper's agents.

    Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning", arXiv 2006.04779,
    equation 4 (CQL(H)) and appendix F, as in d3rlpy 1.1.1, which arXiv 2212.14538 trained with.
    With m samples of each kind (uniform, policy at s, policy at s'), 3m in all, the loss of one
    critic has two terms::

        loss_qvalue  mean over s of (Q(s, a) - r - gamma min_i Q_i'(s', tanh(mean(s'))))^2
        loss_cql     w * mean over s of [logsumexp_j (Q(s, a_j) - log p(a_j)) - Q(s, a)]

    the squared errors summed over the critics, the conservative terms averaged (or summed:
    ``over_critics``); the actor's is the mean of ``alpha log p(a) - min_i Q_i(s, a)``, and the
    temperature's ``-alpha (log p(a) - target_entropy)`` with ``alpha = exp(log_alpha)``.

    `CQLLoss` of TorchRL 0.14 takes a logsumexp over 3 values m times, evaluates the policy's
    actions at s' there instead of at s, samples the action in the target, hands the critics the
    actor's entries, and runs the actor on m copies of each state. Here each distribution is
    computed once and sampled m times, and whatever of a critic does not read the action runs once
    a state.

    The terms are meant to be stepped one after the other, in this order, on the samples of one
    pass: :meth:`alpha_loss`, :meth:`critic_losses`, :meth:`actor_loss`; each then sees what the
    steps before it changed. ``forward`` gives them all at once.

    Args:
        actor_network: Policy with a distribution that has a ``deterministic_sample``, such as that
            of :func:`~torchrl_tit.modules.make_squashed_actor`.
        qvalue_network: Reads what keys it likes (of "next", in the target) and the action, and
            writes "state_action_value", float [..., 1]. Two of them, which start as they were
            built; of a single one TorchRL makes two, and draws their weights anew.
        action_spec: The bounds of an action, a ``Bounded`` spec of shape [A].
        min_q_weight: Weight w of the conservative term.
        num_random: Samples m of each kind.
        over_critics: Whether the conservative term is the mean over the critics, as in d3rlpy
            1.1.1, or their sum, as from its version 2.5 on.
        alpha_init: Temperature at the start.
        target_entropy: What the temperature aims at; minus the entries of an action where "auto".
        loss_function: Distance to the target; "l2" is the square.
        deactivate_vmap: Whether critics run one after the other; needed where they cannot be
            stacked.

    Raises:
        ValueError: If the actions have no bounds, or a setting is not possible.

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

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        *,
        action_spec: Bounded,
        min_q_weight: float = 5.0,
        num_random: int = 10,
        over_critics: OverCritics = "mean",
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        loss_function: str = "l2",
        deactivate_vmap: bool = False,
    ) -> None:
        if not isinstance(action_spec, Bounded) or action_spec.ndim != 1:
            raise ValueError(
                f"action_spec must be a Bounded spec of one dimension, not {action_spec}: samples "
                "are drawn uniformly between the bounds"
            )
        if num_random < 1:
            raise ValueError(f"num_random must be at least 1, not {num_random}")
        if over_critics not in ("mean", "sum"):
            raise ValueError(f"over_critics must be 'mean' or 'sum', not {over_critics!r}")
        super().__init__(
            actor_network,
            [ManyActions(critic) for critic in qvalue_network]
            if isinstance(qvalue_network, Sequence)
            else ManyActions(qvalue_network),
            loss_function=loss_function,
            alpha_init=alpha_init,
            action_spec=action_spec,
            target_entropy=target_entropy,
            min_q_weight=min_q_weight,
            num_random=num_random,
            deactivate_vmap=deactivate_vmap,
        )
        self.over_critics = over_critics
        self.register_buffer("_low", action_spec.space.low.clone())
        self.register_buffer("_high", action_spec.space.high.clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes all terms of a batch [B], which is left as it is.

        Returns:
            "loss_actor", "loss_qvalue", "loss_cql" (weighted), "loss_alpha", "alpha" (the
            temperature) and "entropy" (of the policy, estimated), float [] each.
        """
        samples = self.sample_policy(tensordict)
        loss_qvalue, loss_cql = self.critic_losses(tensordict, samples)
        return TensorDict(
            {
                "loss_actor": self.actor_loss(tensordict, samples)[0],
                "loss_qvalue": loss_qvalue,
                "loss_cql": loss_cql,
                "loss_alpha": self.alpha_loss(samples),
                "alpha": self._alpha,
                "entropy": -samples.log_prob.detach().mean(),
            }
        )

    def sample_policy(
        self, tensordict: TensorDictBase, weights: CQLWeights | None = None
    ) -> PolicySamples:
        """Runs the actor once at s and once at s', and draws what the terms need.

        Args:
            tensordict: a batch [B].
            weights: to use instead of the loss's own.
        """
        return self.draw(*self.run_policy(tensordict, weights))

    def run_policy(
        self, tensordict: TensorDictBase, weights: CQLWeights | None = None
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Runs the actor once at s and, without gradient, once at s'.

        Args:
            tensordict: a batch [B].
            weights: to use instead of the loss's own.

        Returns:
            Parameters of the distributions at s and at s', [B].
        """
        network = self.actor_network
        keys, outputs = network.in_keys, network.dist_params_keys
        actor = (weights or CQLWeights.of(self)).actor
        with actor.to_module(network, preserve_module_state=False):
            here = network.get_dist_params(tensordict.select(*keys))
            with torch.no_grad():
                after = network.get_dist_params(tensordict["next"].select(*keys))
        return here.select(*outputs), after.select(*outputs)

    def draw(self, here: TensorDictBase, after: TensorDictBase) -> PolicySamples:
        """Draws what the terms need.

        Args:
            here: parameters of distributions at s, of any batch shape.
            after: those at s'.
        """
        dist, next_dist = map(self.actor_network.build_dist_from_params, (here, after))
        action, log_prob = rsample_and_log_prob(dist)
        with torch.no_grad():
            shape = torch.Size([self.num_random])
            drawn = [rsample_and_log_prob(d, shape) for d in (dist, next_dist)]
            actions = torch.cat([a for a, _ in drawn]).movedim(0, -2)  # [B, 2n, A]
            log_probs = torch.cat([p for _, p in drawn]).movedim(0, -1)  # [B, 2n]
            next_action = next_dist.deterministic_sample
        return PolicySamples(action, log_prob, actions, log_probs, next_action)

    def alpha_loss(self, samples: PolicySamples, weights: CQLWeights | None = None) -> Tensor:
        """The temperature's loss, float []."""
        surprise = samples.log_prob.detach() + self.target_entropy
        log_alpha = (weights or CQLWeights.of(self)).log_alpha
        return -(log_alpha.exp() * surprise).mean()

    def critic_losses(
        self,
        tensordict: TensorDictBase,
        samples: PolicySamples | None = None,
        weights: CQLWeights | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The critics' squared error and weighted conservative term, float [] each.

        Args:
            tensordict: a batch [B].
            samples: of :meth:`sample_policy`; drawn anew where not given.
            weights: to use instead of the loss's own.
        """
        weights = weights or CQLWeights.of(self)
        samples = samples or self.sample_policy(tensordict, weights)
        questions = self._questions(tensordict, samples, weights.target_critics)
        values = self._values(questions.inputs, weights.critics)
        return self._losses(values, questions, len(questions.target))

    def critic_gradients(
        self, tensordict: TensorDictBase, samples: PolicySamples, states_at_once: int
    ) -> tuple[Tensor, Tensor]:
        """Adds the gradients of :meth:`critic_losses`, summed, to the critics' weights.

        A few states pass forth and back at a time. On a CPU that is faster than all at once: what
        the pass forth leaves is still in the cache when the pass back reads it.

        Args:
            tensordict: a batch [B].
            samples: of :meth:`sample_policy`.
            states_at_once: states that pass at a time, each with its 3m + 1 actions.

        Returns:
            what :meth:`critic_losses` gives, without gradient.
        """
        questions = self._questions(tensordict, samples, self.target_qvalue_network_params)
        parts = questions.split(states_at_once)
        values_of = ReLUMLP.of(self.qvalue_network) or self._values_of_one
        losses = []
        for critic in self._critics():
            with critic.to_module(self.qvalue_network, preserve_module_state=False):
                for part in parts:
                    values = values_of(part.inputs)  # [b, 3n + 1]
                    loss_qvalue, loss_cql = self._losses(values, part, len(questions.target))
                    (loss_qvalue + loss_cql).backward()
                    losses.append(torch.stack([loss_qvalue, loss_cql]).detach())
        loss_qvalue, loss_cql = torch.stack(losses).sum(dim=0).unbind()
        return loss_qvalue, loss_cql

    def q_loss(
        self, tensordict: TensorDictBase, samples: PolicySamples | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """The critics' squared error alone; use :meth:`critic_losses` where both are needed."""
        return self.critic_losses(tensordict, samples)[0], {}

    def cql_loss(
        self, tensordict: TensorDictBase, samples: PolicySamples | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """The weighted conservative term alone; see :meth:`critic_losses`."""
        return self.critic_losses(tensordict, samples)[1], {}

    def actor_loss(
        self,
        tensordict: TensorDictBase,
        samples: PolicySamples | None = None,
        weights: CQLWeights | None = None,
    ) -> tuple[Tensor, dict[str, Any]]:
        """The actor's loss, float [], through critics that get no gradient.

        Args:
            tensordict: a batch [B].
            samples: of :meth:`sample_policy`; drawn anew where not given.
            weights: to use instead of the loss's own.
        """
        weights = weights or CQLWeights.of(self)
        samples = samples or self.sample_policy(tensordict, weights)
        inputs = self._inputs(tensordict, samples.action.unsqueeze(1))
        values = self._values(inputs, weights.critics.detach())  # [critics, B, 1]
        value = values.squeeze(-1).amin(0)  # [B]
        return (weights.log_alpha.detach().exp() * samples.log_prob - value).mean(), {}

    def _target(
        self, tensordict: TensorDictBase, next_action: Tensor, critics: TensorDictBase
    ) -> Tensor:
        """What the critics aim at, without gradient; float [B]."""
        with torch.no_grad():
            inputs = self._inputs(tensordict["next"], next_action.unsqueeze(1))
            values = self._values(inputs, critics)  # [critics, B, 1]
            outcome = tensordict["next"].select(
                self.tensor_keys.reward, self.tensor_keys.terminated, self.tensor_keys.done
            )
            outcome.set(self.value_estimator.tensor_keys.value, values.amin(0))
            batch = TensorDict({"next": outcome}, tensordict.batch_size)
            return self.value_estimator.value_estimate(batch).squeeze(-1)

    def _values(self, inputs: TensorDictBase, params: TensorDictBase) -> Tensor:
        """What all critics say of m actions in each state; [critics, B, m]."""
        answers = self._vmap_qvalue_networkN0(inputs, params)
        return answers.get(self.tensor_keys.state_action_value).squeeze(-1)

    def _values_of_one(self, inputs: TensorDictBase) -> Tensor:
        """What the critic says whose weights are in the network; [B, m]."""
        answers = self.qvalue_network(inputs.copy())
        return answers.get(self.tensor_keys.state_action_value).squeeze(-1)

    def _inputs(self, tensordict: TensorDictBase, actions: Tensor) -> TensorDictBase:
        """What critics read of each state, and several actions there, [B, m, A]."""
        keys = [key for key in self.qvalue_network.in_keys if key != self.tensor_keys.action]
        return tensordict.select(*keys).set(self.tensor_keys.action, actions)

    def _questions(
        self, tensordict: TensorDictBase, samples: PolicySamples, targets: TensorDictBase
    ) -> Questions:
        """What the critics are asked, and what the answers are held against."""
        action = tensordict.get(self.tensor_keys.action)
        batch, size = action.shape
        width = self._high - self._low
        uniform = self._low + width * torch.rand(
            batch, self.num_random, size, dtype=action.dtype, device=action.device
        )
        log_uniform = -width.log().sum().expand(batch, self.num_random)
        actions = torch.cat([uniform, samples.actions, action.unsqueeze(1)], dim=1)
        return Questions(
            inputs=self._inputs(tensordict, actions),
            log_density=torch.cat([log_uniform, samples.log_probs], dim=1),
            target=self._target(tensordict, samples.next_action, targets),
        )

    def _losses(self, values: Tensor, questions: Questions, batch: int) -> tuple[Tensor, Tensor]:
        """The share of b states, and of one critic or all, in the losses of a batch [B].

        Args:
            values: of the actions, float [b, 3n + 1] or [critics, b, 3n + 1].
            questions: what was asked in the states.
            batch: B.
        """
        value = values[..., -1]  # of the action taken; [b] or [critics, b]
        errors = distance_loss(value, questions.target.expand_as(value), self.loss_function)
        optimism = torch.logsumexp(values[..., :-1] - questions.log_density, dim=-1)
        gap = (optimism - value).sum() / batch
        if self.over_critics == "mean":
            gap = gap / self.num_qvalue_nets
        return errors.sum() / batch, self.min_q_weight * gap

    def _critics(self) -> list[TensorDictBase]:
        """The weights of each critic, as leaves whose gradients are parts of the stacked ones."""
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
