"""Policy and value heads: linear layers on the features, as TorchRL modules."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, distributions, nn
from torch.nn.functional import pad
from torchrl.data import Binary, Bounded, Categorical, OneHot, TensorSpec
from torchrl.modules import (
    IndependentNormal,
    MaskedCategorical,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from torchrl_tit.layers import init_orthogonal_
from torchrl_tit.modules.action_specs import (
    action_shape,
    check_bounds,
    describe,
    initial_scale,
    numbers_of_options,
)
from torchrl_tit.modules.distributions import (
    IndependentBernoulli,
    IndependentCategorical,
    IndependentOneHotCategorical,
)
from torchrl_tit.modules.sequences import beside
from torchrl_tit.modules.tensor_module import TensorModule, TensorValue
from torchrl_tit.modules.torch_internals import is_transformed
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Positive, Size


@checked_arguments
def make_actor(
    features_dim: Size,
    action_spec: TensorSpec,
    *,
    in_key: NestedKey = "features",
    action_key: NestedKey | None = None,
    mask_key: NestedKey | None = None,
    batch_dims: int | None = None,
    std: Positive | None = None,
) -> ProbabilisticActor:
    """Builds the policy head for an action space.

    ======================  ==================================================  ====================
    spec                    distribution of an action                           mask
    ======================  ==================================================  ====================
    ``Categorical(n)``      categorical                                         [..., n]
    ``OneHot(n)``           categorical, written as a one-hot vector            [..., n]
    ``MultiCategorical``    independent categoricals                            [..., sum(nvec)]
    ``MultiOneHot``         independent categoricals, one-hot vectors joined    [..., sum(nvec)]
    ``Binary``              independent Bernoullis                              none
    float, of any order     diagonal Gaussian, whose log standard deviation     none
                            is a parameter
    ======================  ==================================================  ====================

    An action has the shape and dtype of the spec, and one log-probability and one entropy: the sums
    over its components. Gaussian actions are neither squashed nor clipped, so the environment
    should clip them (as :func:`~torchrl_tit.envs.make_env` does). The weights start orthogonal with
    gain 0.01, as in Stable-Baselines3, which trained the paper's agents: the initial policy has
    almost the same probabilities in all states (recommended by arXiv 2006.05990).

    Args:
        features_dim: size of the features.
        action_spec: spec of the action, such as ``env.action_spec_unbatched``.
        in_key: key of the features [..., F]. All that is written is in their group: with
            ``("agents", "features")``, there is an ``("agents", "action")``.
        action_key: key of the action; by default "action", in the group of the features.
        mask_key: key of the action mask, bool, True where an action is allowed; the masks of an
            action's components are concatenated. Masked actions have probability 0. None allows
            all.
        batch_dims: number of batch dimensions of ``action_spec``; the others are an action's. By
            default, all but the last dimension of ``OneHot``, ``MultiOneHot`` and
            ``MultiCategorical`` specs, all of a ``Categorical`` spec, none of other specs.
        std: initial standard deviation of continuous actions, as a share of half the range of each
            entry, or in its own units where it has no bounds. None is 1 in its own units, as in
            Stable-Baselines3.

    Returns:
        A :class:`~torchrl.modules.ProbabilisticActor` that writes the action and its
        log-probability [...] and follows TorchRL's exploration type: it samples, or takes the most
        likely action under ``ExplorationType.DETERMINISTIC``. With a mask, it raises ValueError if
        no action is allowed.

    Raises:
        ValueError: for any other action space; if the batch dimensions are ambiguous; or if a mask
            is given for actions that cannot be masked.

    Example:
        >>> from tensordict import TensorDict
        >>> actor = make_actor(64, Categorical(2))
        >>> td = actor(TensorDict({"features": torch.randn(5, 64)}, [5]))
        >>> td["action"].shape, td["action_log_prob"].shape
        (torch.Size([5]), torch.Size([5]))
        >>> from torchrl.data import MultiCategorical
        >>> actor = make_actor(64, MultiCategorical([2, 3]), mask_key="action_mask")
        >>> td["action_mask"] = torch.tensor([True, False, True, False, True]).expand(5, 5)
        >>> actor(td)["action"][:, 0]
        tensor([0, 0, 0, 0, 0])
    """
    shape = action_shape(action_spec, batch_dims)
    if isinstance(action_spec, Categorical | OneHot) and not isinstance(action_spec, Binary):
        parts = _choices(features_dim, action_spec, shape, mask_key)
    elif mask_key is not None:
        raise ValueError(
            f"no action mask for the action space {describe(action_spec)}, only for Categorical, "
            "OneHot, MultiCategorical and MultiOneHot: leave out mask_key"
        )
    elif isinstance(action_spec, Binary):
        parts = _switches(features_dim, action_spec, shape)
    else:
        parts = _gaussian(features_dim, action_spec, shape, initial_scale(action_spec, shape, std))
    in_keys = [in_key] if mask_key is None else [in_key, mask_key]
    parameters = {name: beside(in_key, key) for name, key in parts.parameters.items()}
    return ProbabilisticActor(
        TensorModule(parts.network, in_keys=in_keys, out_keys=list(parameters.values())),
        in_keys=parameters,
        out_keys=[beside(in_key, "action") if action_key is None else action_key],
        distribution_class=parts.distribution,
        distribution_kwargs=parts.settings,
        return_log_prob=True,
        log_prob_key=beside(in_key, "action_log_prob"),
    )


@checked_arguments
def make_squashed_actor(
    features_dim: Size,
    action_spec: TensorSpec,
    *,
    in_key: NestedKey = "features",
    action_key: NestedKey | None = None,
) -> ProbabilisticActor:
    """Builds a tanh-squashed Gaussian policy head on features.

    Two linear layers compute the mean and the logarithm of the standard deviation, clamped to
    -20..2. Samples are squashed by tanh and scaled to the bounds (Haarnoja et al., "Soft
    Actor-Critic", arXiv 1801.01290, appendix C). The deterministic action is the squashed mean.

    With x the value before the tanh, and h half the width of the bounds, an action's log density is
    ``sum(log N(x; loc, scale) - log(h) - 2 (log 2 - x - softplus(-2 x)))``. SAC's and CQL's losses
    draw and score an action at once (``rsample_and_log_prob``), so they know x, and value and
    gradient are exact up to rounding where the action has reached a bound, too. ``log_prob`` of a
    given action recovers x, and cannot at a bound, where the density is 0: it evaluates actions
    closer than 1e-6 h to a bound (float32; 1e-15 h in float64) at that distance from it.

    Args:
        features_dim: size of the features.
        action_spec: a ``Bounded`` spec of one action, without batch dimensions.
        in_key: key of the features [..., F].
        action_key: key of the action, float [..., A]; by default "action", in the group of the
            features.

    Returns:
        A :class:`~torchrl.modules.ProbabilisticActor` that follows TorchRL's exploration type.

    Raises:
        ValueError: if the actions are not continuous and bounded, or the bounds enclose no
            interval of a finite width.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = make_squashed_actor(64, Bounded(-1, 1, shape=(3,)))
        >>> actor(TensorDict({"features": torch.randn(5, 64)}, [5]))["action"].abs().max() <= 1
        tensor(True)
    """
    if not isinstance(action_spec, Bounded) or action_spec.ndim != 1:
        raise ValueError(
            f"no squashed policy for the action space {describe(action_spec)}: expected a Bounded "
            "spec of one dimension, such as env.action_spec_unbatched"
        )
    check_bounds(action_spec, "no squashed policy")
    head = ClampedGaussianHead(features_dim, action_spec.shape[0])
    parameters = {name: beside(in_key, name) for name in ("loc", "scale")}
    return ProbabilisticActor(
        TensorModule(head, in_keys=[in_key], out_keys=list(parameters.values())),
        in_keys=parameters,
        out_keys=[beside(in_key, "action") if action_key is None else action_key],
        distribution_class=TanhNormal,
        distribution_kwargs={
            "low": action_spec.space.low,
            "high": action_spec.space.high,
            "event_dims": 1,
        },
    )


@checked_arguments
def make_value(features_dim: Size, *, in_key: NestedKey = "features") -> ValueOperator:
    """Builds the state-value head: one linear layer, orthogonal with gain 1.

    Args:
        features_dim: size of the features.
        in_key: key of the features [..., F].

    Returns:
        A :class:`~torchrl.modules.ValueOperator` that writes ``"state_value"``, float [..., 1], in
        the group of the features.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> make_value(64)(TensorDict({"features": torch.randn(5, 64)}, [5]))["state_value"].shape
        torch.Size([5, 1])
    """
    value = _Linear(features_dim, 1, gain=1.0)
    return TensorValue(value, in_keys=[in_key], out_keys=[beside(in_key, "state_value")])


class ClampedGaussianHead(nn.Module):
    """Mean and standard deviation of each entry of an action, before a tanh squashes it.

    Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", arXiv 1812.05905, and their
    code: two linear layers with PyTorch's default initialization; the logarithm of the standard
    deviation is clamped to -20..2.

    Args:
        in_features: size F of the features.
        action_dim: entries A of an action.

    Example:
        >>> import torch
        >>> mean, std = ClampedGaussianHead(64, 3)(torch.randn(8, 64))
        >>> mean.shape, std.shape
        (torch.Size([8, 3]), torch.Size([8, 3]))
    """

    def __init__(self, in_features: int, action_dim: int) -> None:
        super().__init__()
        self.mean = nn.Linear(in_features, action_dim)
        self.log_std = nn.Linear(in_features, action_dim)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Float [..., F] -> mean and standard deviation, float [..., A] each."""
        return self.mean(features), self.log_std(features).clamp(-20.0, 2.0).exp()


class _Parts(NamedTuple):
    """The parts of an actor."""

    network: nn.Module
    parameters: dict[str, str]
    """Keys that the network writes, by the name of the distribution's parameter."""
    distribution: type[distributions.Distribution]
    settings: dict[str, Any]


def _choices(
    features_dim: int, spec: Categorical | OneHot, shape: torch.Size, mask_key: NestedKey | None
) -> _Parts:
    """Parts for actions whose components each are one of several options."""
    distribution: type[distributions.Distribution]
    settings: dict[str, Any]
    sizes = numbers_of_options(spec, shape)
    parameters = {"logits": "logits"}
    if mask_key is not None:
        parameters["mask"] = "allowed"
    if isinstance(spec, OneHot):
        distribution, shape = IndependentOneHotCategorical, torch.Size([len(sizes)])
        settings = {"sizes": sizes, "dtype": spec.dtype}
    elif shape or spec.dtype != torch.int64:
        distribution = IndependentCategorical
        settings = {"event_dim": len(shape), "dtype": spec.dtype}
    elif mask_key is not None:
        # Its cross-entropy does not support several samples at once, which compiled losses draw.
        distribution, settings = MaskedCategorical, {"use_cross_entropy": False}
    else:
        # Validating logits and samples takes a third of the head's time at each step.
        distribution, settings = distributions.Categorical, {"validate_args": False}
        return _Parts(_Linear(features_dim, sizes[0]), parameters, distribution, settings)
    network = _ChoicesHead(features_dim, sizes, shape, mask_key)
    return _Parts(network, parameters, distribution, settings)


def _switches(features_dim: int, spec: Binary, shape: torch.Size) -> _Parts:
    """Parts for actions whose components each are on or off."""
    layer = _Linear(features_dim, math.prod(shape))
    network = layer if len(shape) == 1 else nn.Sequential(layer, _Fit(shape))
    settings = {"event_dim": len(shape), "dtype": spec.dtype}
    return _Parts(network, {"logits": "logits"}, IndependentBernoulli, settings)


def _gaussian(features_dim: int, spec: TensorSpec, shape: torch.Size, scale: Tensor) -> _Parts:
    """Parts for continuous actions."""
    network = nn.Sequential(_Linear(features_dim, len(scale)), _Scale(scale))
    if len(shape) != 1 or spec.dtype != torch.float32:
        network.append(_Fit(shape, spec.dtype))
    settings = {"event_dim": len(shape), "validate_args": False}
    return _Parts(network, {"loc": "loc", "scale": "scale"}, IndependentNormal, settings)


class _Linear(nn.Linear):
    """A linear layer whose weights start orthogonal and whose bias starts at 0."""

    def __init__(self, in_features: int, out_features: int, gain: float = 0.01) -> None:
        self.gain = gain  # first, because nn.Linear initializes itself
        super().__init__(in_features, out_features)

    def reset_parameters(self) -> None:
        """Initializes the weights and the bias."""
        super().reset_parameters()
        init_orthogonal_(self, gain=self.gain)


class _Scale(AddStateIndependentNormalScale):
    """TensorDict's scale of a Gaussian, whose logarithm starts at a value, and can be set back."""

    def __init__(self, scale: Tensor) -> None:
        super().__init__(len(scale), scale_lb=0.0)
        self._initial = scale.log()
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Initializes the logarithm of the scale."""
        self.state_independent_scale.copy_(self._initial)


class _Fit(nn.Module):
    """Gives tensors [..., entries] the shape and the dtype of an action."""

    def __init__(self, shape: torch.Size, dtype: torch.dtype | None = None) -> None:
        super().__init__()
        self.shape = shape
        self.dtype = dtype

    def forward(self, tensors: Tensor | tuple[Tensor, ...]) -> Tensor | tuple[Tensor, ...]:
        """[..., entries] -> [..., *shape], for one tensor or each of several."""
        if isinstance(tensors, Tensor):
            dtype = tensors.dtype if self.dtype is None else self.dtype
            return tensors.reshape((*tensors.shape[:-1], *self.shape)).to(dtype)
        return tuple(self(tensor) for tensor in tensors)


class _ChoicesHead(nn.Module):
    """Logits of choices, and which options are allowed.

    Args:
        features_dim: size of the features.
        sizes: number of options of each component.
        shape: the components' shape.
        mask_key: key of the action mask, for error messages; None if there is none.
    """

    def __init__(
        self, features_dim: int, sizes: list[int], shape: torch.Size, mask_key: NestedKey | None
    ) -> None:
        super().__init__()
        self.linear = _Linear(features_dim, sum(sizes))
        self.mask_key = mask_key
        # The logit of each option of each component; the index after the last stands for none.
        columns = torch.full((len(sizes), max(sizes)), sum(sizes))
        for row, numbers in zip(columns, torch.arange(sum(sizes)).split(sizes), strict=True):
            row[: len(numbers)] = numbers
        self.columns: Tensor
        self.register_buffer("columns", columns.view(*shape, -1), persistent=False)

    def forward(
        self, features: Tensor, mask: Tensor | None = None
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Features [..., F] and mask [..., sum(sizes)] -> both [..., *shape, options]."""
        flat = self.linear(features)
        logits = pad(flat, (0, 1), value=-math.inf)[..., self.columns]
        if mask is None:
            return logits
        if mask.shape != flat.shape or mask.dtype != torch.bool:
            raise ValueError(
                f"{self.mask_key!r} must be a bool mask of the shape {list(flat.shape)}, not "
                f"{mask.dtype} of the shape {list(mask.shape)}"
            )
        allowed = pad(mask, (0, 1), value=False)[..., self.columns]
        self._check_allowed(allowed)
        return logits, allowed

    def _check_allowed(self, allowed: Tensor) -> None:
        if is_transformed():
            return
        possible = allowed.any(-1)
        if not possible.all():
            where = (~possible).nonzero()[0].tolist()
            raise ValueError(
                f"{self.mask_key!r} allows no action at {where}: every step (and every component "
                "of an action) needs at least one True"
            )
