"""The quantity to explain: a number per state that a policy computes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase
from torch import Tensor, distributions, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_tit.modules import Backbone
from torchrl_tit.modules.acting import modules_in_order, trunks_of
from torchrl_tit.networks import HistoryNetwork

Target: TypeAlias = Literal["action", "value"] | Callable[[TensorDictBase], Tensor]
"""The quantity to explain, a number per state [N].

"action" is the chosen action's log-probability. The log-probability of a continuous action has no
gradient where the action is the mean, as in evaluation. So for continuous actions it is their size:
the sum of the absolute entries of the policy's deterministic action. For policies that take the
action of the highest value, it is that value.

"value" is the state's value, or the chosen action's if the policy computes those.

A function gets the policy's outputs, and returns float [N].
"""


def find_backbone(policy: nn.Module) -> Backbone:
    """Returns the backbone of a policy.

    Raises:
        ValueError: if there is none, or its network is not from this library.
    """
    backbones = (module for module in policy.modules() if isinstance(module, Backbone))
    backbone = next(backbones, None)
    if backbone is None or not trunks_of(backbone.module):
        raise ValueError(
            f"{type(policy).__name__} has no torchrl_tit.Backbone around a network of this "
            "library, so there is nothing to explain: give it a policy that has one"
        )
    return backbone


def find_network(policy: nn.Module, target: Target = "action") -> HistoryNetwork:
    """Returns the network that computes a target: with two trunks, the policy's or the value's.

    Raises:
        ValueError: see :func:`find_backbone`.
    """
    trunks = trunks_of(find_backbone(policy).module)
    key = "value_" if target == "value" else "policy_"
    return trunks[key] if key in trunks else trunks[""]


def histories_of(policy: nn.Module, tensordict: TensorDictBase) -> list[Tensor]:
    """Returns the inputs of the policy's network, as its ``forward`` takes them.

    Raises:
        ValueError: see :func:`find_backbone`.
        KeyError: if the tensordict lacks one of them.
    """
    return [tensordict[key] for key in find_backbone(policy).history_keys]


def run_policy(
    policy: TensorDictModuleBase, tensordict: TensorDictBase
) -> tuple[TensorDictBase, distributions.Distribution | None]:
    """Runs a policy on single steps, with gradients where they are enabled.

    Args:
        policy: any policy; the deterministic action is taken.
        tensordict: its inputs, [N], which are left unchanged.

    Returns:
        The policy's outputs, and the distribution of actions, if there is one.
    """
    outputs, distribution = tensordict.copy(), None
    with set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(False):
        for module in modules_in_order(policy):
            if isinstance(module, ProbabilisticTensorDictModule):
                distribution = module.get_dist(outputs)
            outputs = module(outputs)
    return outputs, distribution


def compute_target(
    policy: TensorDictModuleBase, tensordict: TensorDictBase, target: Target
) -> Tensor:
    """Computes a target.

    Args:
        policy: the policy.
        tensordict: its inputs, [N], and "action" if that is not the deterministic one.
        target: see :data:`Target`.

    Returns:
        float [N].

    Raises:
        ValueError: if the policy does not compute it, or there is no such target.
    """
    outputs, distribution = run_policy(policy, tensordict)
    if callable(target):
        return target(outputs).reshape(len(tensordict))
    if target == "value":
        for key in ("state_value", "chosen_action_value"):
            value = outputs.get(key, None)
            if value is not None:
                return value.reshape(len(tensordict))
        raise ValueError(
            "this policy computes actions only, no values (state_value or chosen_action_value): "
            "explain its action"
        )
    if target != "action":
        raise ValueError(f"a target is 'action', 'value' or a function, not {target!r}")
    best = outputs["action"]
    if best.is_floating_point():
        return best.abs().flatten(1).sum(1)
    action = tensordict.get("action", None)
    action = best if action is None else action
    if distribution is not None:
        return distribution.log_prob(action).reshape(len(tensordict))
    values = outputs["action_value"]  # [N, actions]
    return values.gather(-1, action.reshape(-1, 1)).squeeze(-1)


def as_batch(tensordict: TensorDictBase) -> TensorDictBase:
    """Returns states with one batch dimension, [N].

    Raises:
        ValueError: if they have several.
    """
    if tensordict.ndim > 1:
        raise ValueError(
            f"states are explained one by one, [N], not {list(tensordict.batch_size)}: flatten them"
        )
    return tensordict if tensordict.ndim else tensordict.unsqueeze(0)


def check_gradient(value: Tensor, target: Target) -> None:
    """Raises ValueError if a target depends on nothing."""
    if not value.requires_grad:
        raise ValueError(
            f"{target_name(target)} does not depend on what the network reads: choose another "
            "target"
        )


def target_name(target: Target) -> str:
    """What messages call a target."""
    return target if isinstance(target, str) else getattr(target, "__name__", "the target")
