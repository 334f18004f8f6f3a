"""Integrated gradients: what each entry of an observation contributes to a target."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_tit.analysis.targets import (
    Target,
    as_batch,
    check_gradient,
    compute_target,
    find_backbone,
    find_network,
    run_policy,
    target_name,
)
from torchrl_tit.extras import install
from torchrl_tit.layers.images import bytes_to_floats
from torchrl_tit.networks.building import evaluating


def integrated_gradients(
    policy: TensorDictModuleBase,
    tensordict: TensorDictBase,
    *,
    target: Target = "action",
    steps: int = 32,
    tolerance: float = 0.01,
) -> dict[str, Tensor]:
    """Attributes a target to the entries of observations, with captum's integrated gradients.

    The attributions of a state add up to the difference in the target between its observations and
    zeros: gradients are averaged on the straight line between them (Sundararajan et al., "Axiomatic
    Attribution for Deep Networks", arXiv 1703.01365). The chosen action, recurrent states and
    categories, which have no gradient, are left unchanged.

    Args:
        policy: a policy with a :class:`~torchrl_tit.modules.Backbone`; dropout is off.
        tensordict: what the policy reads, [N] or []; its "action", if there is one, is the chosen
            one.
        target: what is explained; see :data:`~torchrl_tit.analysis.targets.Target`.
        steps: number of points on the line to begin with. They are doubled, up to 32 times as many,
            until the sum is as exact as ``tolerance`` says.
        tolerance: how far the sum may be off, as a share of the sum of all magnitudes.

    Returns:
        Attributions by the name of the observation, float [N, K, *observation], for arrays and
        images.

    Raises:
        ValueError: if captum is missing, the network reads only categories, or the policy does not
            compute the target.

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> from torchrl_tit.modules import make_actor
        >>> tit = EnhancedTIT((4,), num_frames=8)
        >>> policy = TensorDictSequential(Backbone(tit), make_actor(64, Categorical(2)))
        >>> state = TensorDict({"history": torch.randn(2, 8, 4)}, [2])
        >>> integrated_gradients(policy, state)["observation"].shape
        torch.Size([2, 8, 4])
    """
    network, backbone = find_network(policy, target), find_backbone(policy)
    keys = {
        name: key
        for (name, seen), key in zip(
            network.observations.items(), backbone.history_keys, strict=False
        )
        if seen.kind != "categories"
    }
    if not keys:
        raise ValueError(
            "this network reads categories only, which have no gradient to integrate: look at its "
            "attention"
        )
    method = _captum()
    state = as_batch(tensordict)
    if state.get("action", None) is None:
        with evaluating(policy), torch.no_grad():
            state = state.copy().set("action", run_policy(policy, state)[0]["action"])
    inputs = {name: bytes_to_floats(state[key]) for name, key in keys.items()}
    starts = {name: torch.zeros_like(x) for name, x in inputs.items()}
    for name, encoder in zip(network.observations, network.frames, strict=True):
        if encoder.reads_entities:  # the same rows are entities
            starts[name][..., -1] = inputs[name][..., -1]

    def compute(*histories: Tensor) -> Tensor:
        repeats = len(histories[0]) // len(state)
        states = state.expand(repeats, len(state)).reshape(-1).copy()
        for key, history in zip(keys.values(), histories, strict=True):
            states.set(key, history)
        value = compute_target(policy, states, target)
        if torch.is_grad_enabled():  # captum also computes both ends without a gradient
            check_gradient(value, target)
        return value

    integrate = method(compute)
    with evaluating(policy), torch.enable_grad():
        for points in (steps * 2**doubled for doubled in range(6)):
            shares, missing = integrate.attribute(
                tuple(inputs.values()),
                tuple(starts.values()),
                n_steps=points,
                internal_batch_size=steps * len(state),
                return_convergence_delta=True,
            )
            whole = torch.stack([share.abs().flatten(1).sum(1) for share in shares]).sum(0)
            off = (missing.abs() / whole.clamp(min=torch.finfo(whole.dtype).tiny)).max()
            if off <= tolerance:
                break
        else:
            warnings.warn(
                f"with {points} points, attributions miss the difference in the "
                f"{target_name(target)} by up to {off:.1%} of their magnitudes, more than "
                f"tolerance {tolerance:.1%}: raise steps ({steps}), or tolerance",
                stacklevel=2,
            )
    return {name: share.detach() for name, share in zip(inputs, shares, strict=True)}


def _captum() -> type[Any]:
    try:
        from captum.attr import IntegratedGradients  # an optional extra
    except ImportError as error:
        raise ValueError(
            f"integrated gradients need captum: {install('captum')} ({error})"
        ) from error
    return IntegratedGradients
