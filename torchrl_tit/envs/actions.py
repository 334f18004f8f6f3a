"""Converts Gymnasium's action spaces to TorchRL's specs, and actions to those of the tasks."""

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space
from numpy.typing import NDArray
from torchrl.data import Binary, Bounded, Categorical, TensorSpec, Unbounded

from torchrl_tit.envs.spaces import categories_spec


class ActionWriter:
    """Converts actions from tensordicts for a vector of Gymnasium tasks.

    Args:
        space: The action space of one task.
        clip: Whether continuous actions are clipped to their bounds, so that their spec is
            unbounded.

    Raises:
        ValueError: If actions of that kind are not supported.

    Example:
        >>> write = ActionWriter(Discrete(3, start=-1), clip=True)
        >>> write.spec.space.n, write(np.array([0, 2]))
        (3, array([-1,  1]))
    """

    def __init__(self, space: Space, *, clip: bool) -> None:
        self.start: int | NDArray | None = None
        """Offset that is added to integers; None for no offset."""
        self.bounds: tuple[NDArray, NDArray] | None = None
        """Bounds to which actions are clipped; None if they are not."""
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
            self.bounds = (low, high) if clip else None
            self.spec = box_action_spec(low, high, clip=clip)
            if space.dtype.kind != "f":
                self.dtype = space.dtype
        else:
            raise ValueError(
                f"Actions of the kind {space} are not supported, only Discrete, MultiDiscrete, "
                "MultiBinary and Box; a wrapper of the task can convert them."
            )
        if self.spec.shape != space.shape:
            self.shape = space.shape

    def __call__(self, actions: NDArray) -> NDArray:
        """Converts actions [N, *spec] to the tasks' actions, [N, *space]."""
        if self.bounds is not None:
            actions = actions.clip(*self.bounds)
        if self.start is not None:
            actions = actions + self.start
        if self.dtype is not None:
            actions = np.rint(actions).astype(self.dtype)
        return actions if self.shape is None else actions.reshape(len(actions), *self.shape)


def box_action_spec(low: NDArray, high: NDArray, *, clip: bool) -> TensorSpec:
    """The spec of continuous actions; float32 [A]. The bounds are [A]."""
    if clip:
        return Unbounded(low.shape, dtype=torch.float32)
    bounds = [torch.from_numpy(bound.astype(np.float32)) for bound in (low, high)]
    return Bounded(*bounds, low.shape, dtype=torch.float32)
