"""Distributions of actions with several discrete components: one log-probability for all of them.

They build on PyTorch's `Independent`, as TorchRL's `IndependentNormal` does, and write actions in
the format of a spec. TorchRL's `OneHotCategorical` writes int64 where a `OneHot` spec is bool, and
its mode has several ones if logits are equal.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Size, Tensor, distributions
from torch.distributions.kl import register_kl
from torch.nn.functional import one_hot
from torchrl.modules import MaskedCategorical


class IndependentCategorical(distributions.Independent):
    """Several choices, each of one option: the actions of a `MultiCategorical` spec.

    Args:
        logits: [*batch, *components, options]; -inf where a component has fewer options.
        mask: bool, True where an option is allowed, of the same shape; None if all are.
        event_dim: number of dimensions of ``components``.
        dtype: dtype of the actions.

    Example:
        >>> policy = IndependentCategorical(torch.zeros(5, 2, 3))  # two choices of three options
        >>> policy.sample().shape, policy.log_prob(policy.mode).shape
        (torch.Size([5, 2]), torch.Size([5]))
        >>> policy.entropy()[0].exp()
        tensor(9.)
    """

    def __init__(
        self,
        logits: Tensor,
        mask: Tensor | None = None,
        *,
        event_dim: int = 1,
        dtype: torch.dtype = torch.int64,
    ) -> None:
        base: distributions.Categorical
        if mask is None:
            base = distributions.Categorical(logits=logits, validate_args=False)
        else:  # its cross-entropy does not support several samples at once
            base = MaskedCategorical(logits=logits, mask=mask, use_cross_entropy=False)
        super().__init__(base, event_dim, validate_args=False)
        self._dtype, self._logits = dtype, logits

    @property
    def exists(self) -> Tensor:
        """Whether a component has an option, allowed or not; bool, of the shape of the logits."""
        return self._logits != -torch.inf

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draws actions, [*sample_shape, *batch, *components]."""
        return self._encode(super().sample(Size(sample_shape)))

    @property
    def mode(self) -> Tensor:
        """The most likely action; if there are several, the first."""
        return self._encode(self.base_dist.mode)

    @property
    def deterministic_sample(self) -> Tensor:
        """The mode, under the name that TorchRL uses."""
        return self.mode

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probabilities of actions, float [*batch]; -inf for actions that are not allowed."""
        return super().log_prob(self._decode(value))

    def _encode(self, options: Tensor) -> Tensor:
        return options.to(self._dtype)

    def _decode(self, value: Tensor) -> Tensor:
        return value.long()


@register_kl(IndependentCategorical, IndependentCategorical)
def _kl(p: IndependentCategorical, q: IndependentCategorical) -> Tensor:
    """The divergence; PyTorch's subtracts infinite logits of missing options: NaN in gradients."""
    first, second = p.base_dist, q.base_dist
    missing = first.probs == 0
    ratio = first.logits.masked_fill(missing, 0) - second.logits.masked_fill(missing, 0)
    return (first.probs * ratio).flatten(len(p.batch_shape)).sum(-1)


class IndependentOneHotCategorical(IndependentCategorical):
    """Several choices written as one-hot vectors: the actions of `OneHot` and `MultiOneHot` specs.

    Args:
        logits: [*batch, components, options]; -inf where a component has fewer options.
        mask: bool, True where an option is allowed, of the same shape; None if all are.
        sizes: number of options of each component; actions are [*batch, sum(sizes)].
        dtype: dtype of the actions.

    Example:
        >>> logits = torch.tensor([[0.0, 1.0, -torch.inf], [2.0, 0.0, 1.0]])
        >>> IndependentOneHotCategorical(logits, sizes=(2, 3), dtype=torch.int64).mode
        tensor([0, 1, 1, 0, 0])
    """

    def __init__(
        self,
        logits: Tensor,
        mask: Tensor | None = None,
        *,
        sizes: Sequence[int],
        dtype: torch.dtype = torch.bool,
    ) -> None:
        super().__init__(logits, mask, dtype=dtype)
        self._sizes = list(sizes)

    @property
    def event_shape(self) -> Size:
        """The shape of an action: the one-hot vectors side by side."""
        return Size([sum(self._sizes)])

    def _encode(self, options: Tensor) -> Tensor:
        components = zip(options.unbind(-1), self._sizes, strict=True)
        return torch.cat([one_hot(choice, size) for choice, size in components], -1).to(self._dtype)

    def _decode(self, value: Tensor) -> Tensor:
        components = value.byte().split(self._sizes, -1)  # argmax does not support bool
        return torch.stack([component.argmax(-1) for component in components], -1)


class IndependentBernoulli(distributions.Independent):
    """Several switches, each on or off: the actions of a `Binary` spec.

    Args:
        logits: logits of "on", [*batch, *switches].
        event_dim: number of dimensions of ``switches``.
        dtype: dtype of the actions.

    Example:
        >>> policy = IndependentBernoulli(torch.tensor([[1.0, -1.0, 0.0]]))
        >>> policy.mode
        tensor([[1, 0, 0]], dtype=torch.int8)
        >>> policy.log_prob(policy.sample()).shape
        torch.Size([1])
    """

    def __init__(
        self, logits: Tensor, *, event_dim: int = 1, dtype: torch.dtype = torch.int8
    ) -> None:
        base = distributions.Bernoulli(logits=logits, validate_args=False)
        super().__init__(base, event_dim, validate_args=False)
        self._dtype = dtype

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draws actions, [*sample_shape, *batch, *switches]."""
        return super().sample(Size(sample_shape)).to(self._dtype)

    @property
    def mode(self) -> Tensor:
        """The most likely action; off if both are equally likely, where PyTorch returns NaN."""
        return (self.base_dist.logits > 0).to(self._dtype)

    @property
    def deterministic_sample(self) -> Tensor:
        """The mode, under the name that TorchRL uses."""
        return self.mode

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probabilities of actions, float [*batch]."""
        return super().log_prob(value.to(self.base_dist.logits.dtype))
