"""The policy head of CQL and SAC: a Gaussian that is squashed into the action bounds."""

from __future__ import annotations

from tensordict import NestedKey
from torchrl.data import Bounded, TensorSpec
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_tit.layers.gaussian_head import ClampedGaussianHead
from torchrl_tit.modules.action_specs import check_bounds, describe
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Size


@checked_arguments
def make_squashed_actor(
    features_dim: Size,
    action_spec: TensorSpec,
    *,
    in_key: NestedKey = "features",
    action_key: NestedKey = "action",
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
        action_key: key of the action, float [..., A].

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
    return ProbabilisticActor(
        TensorModule(head, in_keys=[in_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=TanhNormal,
        distribution_kwargs={
            "low": action_spec.space.low,
            "high": action_spec.space.high,
            "event_dims": 1,
        },
    )
