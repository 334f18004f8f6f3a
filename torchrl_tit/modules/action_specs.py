"""Reads specs of actions: the shape of an action, and the options of its components."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
)


def action_shape(spec: TensorSpec, batch_dims: int | None) -> torch.Size:
    """Finds the shape of one action.

    Args:
        spec: the action's spec.
        batch_dims: number of its batch dimensions; None to infer it from the kind of the spec.

    Raises:
        ValueError: if there is no policy head for this kind of spec, or the number cannot be
            inferred.

    Example:
        >>> action_shape(OneHot(3, shape=(8, 3)), None)
        torch.Size([3])
    """
    supported = isinstance(spec, Categorical | OneHot) or (
        isinstance(spec, TensorSpec)
        and not isinstance(spec, Composite)
        and spec.dtype.is_floating_point
    )
    if not supported:
        raise ValueError(
            f"no policy head for the action space {describe(spec)}: expected a Categorical, "
            "OneHot, MultiCategorical, MultiOneHot, Binary or float spec"
        )
    if batch_dims is None:
        if isinstance(spec, Binary) or not isinstance(spec, Categorical | OneHot):
            if spec.ndim > 1:
                raise ValueError(
                    f"it is not clear how many dimensions of the action space {describe(spec)} are "
                    "batch: pass env.action_spec_unbatched, with batch_dims=0 if an action has "
                    "more than one dimension"
                )
            batch_dims = 0
        else:
            own = isinstance(spec, MultiCategorical | OneHot)
            batch_dims = spec.ndim - own
    if not 0 <= batch_dims <= spec.ndim:
        raise ValueError(
            f"batch_dims must be at least 0 and at most {spec.ndim}, the dimensions of the action "
            f"space {describe(spec)}, not {batch_dims}"
        )
    return spec.shape[batch_dims:]


def numbers_of_options(spec: Categorical | OneHot, shape: torch.Size) -> list[int]:
    """Finds the number of options of each component of an action.

    Args:
        spec: the action's spec.
        shape: the shape of one action.

    Raises:
        ValueError: if the number differs between the actions of a batched spec, or the action
            consists of several rows of one-hot vectors.

    Example:
        >>> numbers_of_options(MultiCategorical([2, 3]), torch.Size([2]))
        [2, 3]
    """
    if isinstance(spec, MultiCategorical):
        numbers = spec.nvec.reshape(-1, *shape)
        if (numbers != numbers[0]).any():
            raise ValueError(
                f"the action space {describe(spec)} has other numbers of options in each row: pass "
                "env.action_spec_unbatched, with batch_dims=0 if an action has several dimensions"
            )
        return numbers[0].flatten().tolist()
    if isinstance(spec, OneHot) and len(shape) != 1:
        raise ValueError(
            f"an action of the shape {list(shape)} in the action space {describe(spec)} is not "
            "supported: one-hot vectors have one dimension, so raise batch_dims"
        )
    if isinstance(spec, MultiOneHot):
        return list(spec.nvec)
    return [spec.space.n] * (1 if isinstance(spec, OneHot) else math.prod(shape))


def half_range(spec: Bounded) -> Tensor:
    """Half the range of each entry of an action within bounds, float [A].

    Example:
        >>> half_range(Bounded(-2, 4, (2,)))
        tensor([3., 3.])
    """
    return (spec.space.high - spec.space.low) / 2


def has_bounds(spec: TensorSpec) -> bool:
    """Whether actions are floats [A], each within bounds whose sum and difference are finite.

    Example:
        >>> has_bounds(Bounded(-1, 1, (3,))), has_bounds(Bounded(0, math.inf, (3,)))
        (True, False)
    """
    if not isinstance(spec, Bounded) or spec.ndim != 1 or not spec.dtype.is_floating_point:
        return False
    low, high = spec.space.low, spec.space.high
    return bool(((low < high) & (high - low).isfinite() & (high + low).isfinite()).all())


def check_bounds(spec: TensorSpec, refusal: str) -> None:
    """Raises ValueError, which begins with ``refusal``, if a `Bounded` spec lacks usable bounds."""
    if not has_bounds(spec):
        raise ValueError(
            f"{refusal} for actions from {spec.space.low.tolist()} to {spec.space.high.tolist()}: "
            "each lower bound must be below the upper one, and their difference and sum finite "
            f"in {spec.dtype}"
        )


def initial_scale(spec: TensorSpec, shape: torch.Size, std: float | None) -> Tensor:
    """The standard deviation with which Gaussian actions start.

    Args:
        spec: the action's spec.
        shape: the shape of one action.
        std: share of half the range of each entry, or of 1 where it has no bounds; None for 1.

    Returns:
        float [entries].

    Example:
        >>> spec = Bounded(torch.tensor([-2.0, 0.0]), torch.tensor([2.0, math.inf]))
        >>> initial_scale(spec, spec.shape, 0.5)
        tensor([1.0000, 0.5000])
    """
    if std is None:
        return torch.ones(math.prod(shape))
    half = torch.ones(spec.shape)
    if isinstance(spec, Bounded):
        half = half_range(spec).to(half)
    half = half.reshape(-1, math.prod(shape))[0]
    return std * half.where(half.isfinite() & (half > 0), 1.0)


def describe(spec: TensorSpec) -> str:
    """Describes a spec in one line.

    Example:
        >>> describe(Binary(3))
        'Binary(shape=[3], dtype=int8, n=2)'
        >>> describe(Bounded(-2.0, 2.0, (1,)))
        'BoundedContinuous(shape=[1], dtype=float32, low=-2.0, high=2.0)'
        >>> describe(Bounded(torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 1.0])))
        'BoundedContinuous(shape=[2], dtype=float32, low=[-1.0, -2.0], high=1.0)'
        >>> describe(MultiCategorical([3, 2]))
        'MultiCategorical(shape=[2], dtype=int64, n=[3, 2])'
    """
    if not isinstance(spec, TensorSpec):
        return repr(spec)
    if isinstance(spec, Composite):
        return f"Composite({', '.join(map(str, spec.keys()))})"
    said: dict[str, Any] = {
        "shape": list(spec.shape),
        "dtype": str(spec.dtype).removeprefix("torch."),
    }
    if isinstance(spec, Bounded):
        for end, bound in (("low", spec.space.low), ("high", spec.space.high)):
            values = bound.unique().tolist()
            said[end] = values[0] if len(values) == 1 else bound.tolist()
    if isinstance(spec, MultiCategorical):
        said["n"] = spec.nvec.tolist()
    elif isinstance(spec, Categorical):
        said["n"] = spec.space.n
    kind = type(spec).__name__
    return f"{kind}({', '.join(f'{name}={value}' for name, value in said.items())})"
