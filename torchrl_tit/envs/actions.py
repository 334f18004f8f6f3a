"""Converts Gymnasium's action spaces to TorchRL's specs, and actions to those of the tasks."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space
from numpy.typing import NDArray
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, TensorSpec, Unbounded


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
        >>> write.spec.space.n, write(torch.tensor([0, 2]))
        (3, tensor([-1,  1]))
        >>> ActionWriter(Box(0, 9, (1,), np.int64), clip=False)(torch.tensor([[1e20]]))
        tensor([[9]])
    """

    def __init__(self, space: Space, *, clip: bool) -> None:
        self.start: Tensor | None = None
        """Offset that is added to integers; None for no offset."""
        self.bounds: tuple[Tensor, Tensor] | None = None
        """Bounds to which actions are clipped, float32 or of the task's integers; None if they are
        not."""
        if isinstance(space, Discrete):
            self.spec: TensorSpec = Categorical(int(space.n), dtype=torch.int64)
            self.start = torch.tensor(int(space.start)) if space.start else None
        elif isinstance(space, MultiDiscrete):
            self.spec = MultiCategorical(space.nvec.flatten().tolist())
            self.start = torch.from_numpy(space.start.flatten()) if space.start.any() else None
        elif isinstance(space, MultiBinary):
            size = int(np.prod(space.shape))
            self.spec = Binary(size, shape=(size,), dtype=torch.int8)
        elif isinstance(space, Box) and space.dtype.kind in "fiu":
            low, high = (np.asarray(x).reshape(-1) for x in (space.low, space.high))
            self.spec = box_action_spec(low, high, clip=clip)
            if space.dtype.kind != "f":
                self.bounds = torch.from_numpy(low), torch.from_numpy(high)
            elif clip:
                low, high = _float32_bounds(low, high)
                self.bounds = torch.from_numpy(low), torch.from_numpy(high)
        else:
            raise ValueError(
                f"Actions of the kind {space} are not supported, only Discrete, MultiDiscrete, "
                "MultiBinary and Box; a wrapper of the task can convert them."
            )
        self.shape: tuple[int, ...] | None = None if self.spec.shape == space.shape else space.shape
        """The shape of a task's action; None if it is the same as the spec's."""

    def __call__(self, actions: Tensor) -> Tensor:
        """Converts actions [N, *spec], which are not NaN, to the tasks' actions, [N, *space]."""
        if self.bounds is not None and self.bounds[0].is_floating_point():
            actions = actions.clamp(*self.bounds)
        elif self.bounds is not None:
            # Clipped to the bounds before a conversion to integers could wrap them.
            (low, high), actions = self.bounds, actions.round()
            below, above = actions <= low, actions >= high
            inside = torch.where(below | above, 0, actions).to(low.dtype)
            actions = torch.where(below, low, torch.where(above, high, inside))
        if self.start is not None:
            actions = actions + self.start
        return actions if self.shape is None else actions.reshape(actions.shape[0], *self.shape)


def refuse_nan(actions: Tensor) -> None:
    """Raises ValueError if an action, [..., A], is NaN, which clipping would let pass."""
    wrong = actions.isnan()
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
