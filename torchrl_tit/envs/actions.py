"""Converts Gymnasium's action spaces to TorchRL's specs, and actions to those of the tasks."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space
from numpy.typing import NDArray
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, TensorSpec, Unbounded

from torchrl_tit.envs.spaces import categories_spec


class ActionWriter:
    """Converts actions from tensordicts for a vector of Gymnasium tasks.

    Args:
        space: the action space of one task.
        clip: whether continuous actions are clipped to their bounds, so that their spec is
            unbounded. Actions of a Box of integers are rounded and clipped in either case.

    Raises:
        ValueError: if actions of that kind are not supported.

    Example:
        >>> write = ActionWriter(Discrete(3, start=-1), clip=True)
        >>> write.spec.space.n, write(np.array([0, 2]))
        (3, array([-1,  1]))
        >>> ActionWriter(Box(0, 9, (1,), np.int64), clip=False)(np.array([[1e20]]))
        array([[9]])
    """

    def __init__(self, space: Space, *, clip: bool) -> None:
        self.start: int | NDArray | None = None
        """Offset that is added to integers; None for no offset."""
        self.bounds: tuple[NDArray, NDArray] | None = None
        """Bounds to which actions are clipped, float32 or the integers' dtype; None if they are
        not."""
        self.shape: tuple[int, ...] | None = None
        """The shape of a task's action; None if it is the same as the spec's."""
        self.dtype: np.dtype | None = None
        """The integer dtype to which floats are rounded; None if they are not."""
        if isinstance(space, Discrete):
            self.spec: TensorSpec = Categorical(int(space.n), dtype=torch.int64)
            self.start = int(space.start) or None
        elif isinstance(space, MultiDiscrete):
            self.spec = categories_spec(space.nvec.flatten().tolist())
            self.start = space.start.flatten() if space.start.any() else None
        elif isinstance(space, MultiBinary):
            size = int(np.prod(space.shape))
            self.spec = Binary(size, shape=(size,), dtype=torch.int8)
        elif isinstance(space, Box) and space.dtype.kind in "fiu":
            low, high = (np.asarray(x).reshape(-1) for x in (space.low, space.high))
            self.spec = box_action_spec(low, high, clip=clip)
            if space.dtype.kind != "f":
                self.dtype, self.bounds = space.dtype, (low, high)
            elif clip:
                self.bounds = _float32_bounds(low, high)
        else:
            raise ValueError(
                f"Actions of the kind {space} are not supported, only Discrete, MultiDiscrete, "
                "MultiBinary and Box; a wrapper of the task can convert them."
            )
        if self.spec.shape != space.shape:
            self.shape = space.shape

    def __call__(self, actions: NDArray) -> NDArray:
        """Converts actions [N, *spec] to the tasks' actions, [N, *space].

        Raises:
            ValueError: if an action is NaN.
        """
        if actions.dtype.kind == "f":
            refuse_nan(actions)
        if self.dtype is not None:
            actions = self._round(actions)
        elif self.bounds is not None:
            actions = actions.clip(*self.bounds)
        if self.start is not None:
            actions = actions + self.start
        return actions if self.shape is None else actions.reshape(len(actions), *self.shape)

    def _round(self, actions: NDArray) -> NDArray:
        """Rounds floats to integers, clipped to the bounds before a conversion could wrap them."""
        assert self.bounds is not None
        low, high = self.bounds
        actions = np.rint(actions)
        below, above = actions <= low, actions >= high
        inside = np.where(below | above, 0, actions).astype(self.dtype)
        return np.where(below, low, np.where(above, high, inside))


def refuse_nan(actions: NDArray | Tensor) -> None:
    """Raises ValueError if an action, [..., A], is NaN, which clipping would let pass."""
    wrong: Any = actions != actions
    if wrong.any():
        raise ValueError(
            f"the action {actions[wrong.any(-1)][0].tolist()} is not a number: expected numbers "
            "only; look for NaN in the policy's weights and in the observations"
        )


def box_action_spec(low: NDArray, high: NDArray, *, clip: bool) -> TensorSpec:
    """The spec of continuous actions; float32 [A]. The bounds are [A], and may be infinite."""
    if clip or (np.isinf(low) & np.isinf(high)).all():
        return Unbounded(low.shape, dtype=torch.float32)
    bounds = [torch.from_numpy(bound) for bound in _float32_bounds(low, high)]
    return Bounded(*bounds, low.shape, dtype=torch.float32)


def _float32_bounds(low: NDArray, high: NDArray) -> tuple[NDArray, NDArray]:
    """Rounds bounds inwards: the nearest float32 of 0.3, for example, is above it."""
    with np.errstate(over="ignore"):  # to infinity, and from there to the largest float32
        bottom, top = low.astype(np.float32), high.astype(np.float32)
    bottom = np.where(bottom < low, np.nextafter(bottom, np.float32(np.inf)), bottom)
    top = np.where(top > high, np.nextafter(top, np.float32(-np.inf)), top)
    return bottom, np.maximum(bottom, top)  # equal bounds stay equal
