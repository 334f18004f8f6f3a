"""Policy and value heads: one linear layer on the features, as TorchRL modules."""

from __future__ import annotations

from tensordict import NestedKey
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import distributions, nn
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.modules import (
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    ValueOperator,
)

from torchrl_tit.layers import init_orthogonal_


def make_actor(
    features_dim: int,
    action_spec: TensorSpec,
    *,
    in_key: NestedKey = "features",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    """Builds the policy head for an action space.

    Discrete actions have a categorical distribution. Continuous ones have a diagonal Gaussian whose
    log standard deviation is a parameter that starts at 0; they are neither squashed nor clipped,
    so the environment should clip them. The weights start orthogonal with gain 0.01, as in
    Stable-Baselines3, which trained the paper's agents.

    Args:
        features_dim: size of the features.
        action_spec: spec of one action without batch dimensions: ``Categorical``, ``OneHot`` or a
            one-dimensional float spec.
        in_key: key of the features [..., F].
        action_key: key of the action: int64 [...], bool [..., n], or float [..., n].

    Returns:
        A :class:`~torchrl.modules.ProbabilisticActor` that writes the action and its
        log-probability [...] and follows TorchRL's exploration type: random, or the most likely
        action under ``ExplorationType.DETERMINISTIC``.

    Raises:
        ValueError: for any other action space.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = make_actor(64, Categorical(2))
        >>> td = actor(TensorDict({"features": torch.randn(5, 64)}, [5]))
        >>> td["action"].shape, td["action_log_prob"].shape
        (torch.Size([5]), torch.Size([5]))
    """
    network: nn.Module
    distribution: type[distributions.Distribution]
    if isinstance(action_spec, Categorical | OneHot):
        network = nn.Linear(features_dim, action_spec.space.n)
        parameters = ["logits"]
        categorical = isinstance(action_spec, Categorical)
        distribution = distributions.Categorical if categorical else OneHotCategorical
    elif action_spec.dtype.is_floating_point and action_spec.ndim == 1:
        size = action_spec.shape[0]
        network = nn.Sequential(
            nn.Linear(features_dim, size), AddStateIndependentNormalScale(size, scale_lb=0.0)
        )
        parameters = ["loc", "scale"]
        distribution = IndependentNormal
    else:
        raise ValueError(
            f"no policy head for the action space {action_spec}: expected a Categorical or OneHot "
            "spec, or a float spec of one dimension, without batch dimensions"
        )
    init_orthogonal_(network, gain=0.01)
    # Validating logits and samples takes a third of the head's time at each step.
    checks = {} if distribution is OneHotCategorical else {"validate_args": False}
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[in_key], out_keys=parameters),
        in_keys=parameters,
        out_keys=[action_key],
        distribution_class=distribution,
        distribution_kwargs=checks,
        return_log_prob=True,
        log_prob_key="action_log_prob",
    )


def make_value(features_dim: int, *, in_key: NestedKey = "features") -> ValueOperator:
    """Builds the state-value head: one linear layer, orthogonal with gain 1.

    Args:
        features_dim: size of the features.
        in_key: key of the features [..., F].

    Returns:
        A :class:`~torchrl.modules.ValueOperator` that writes ``"state_value"``, float [..., 1].

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> make_value(64)(TensorDict({"features": torch.randn(5, 64)}, [5]))["state_value"].shape
        torch.Size([5, 1])
    """
    layer = nn.Linear(features_dim, 1)
    init_orthogonal_(layer, gain=1.0)
    return ValueOperator(layer, in_keys=[in_key])
