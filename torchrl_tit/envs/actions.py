"""Gymnasium's spaces of actions as TorchRL's specs, and actions on their way to the tasks."""

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space
from numpy.typing import NDArray
from torchrl.data import Binary, Bounded, Categorical, TensorSpec, Unbounded

from torchrl_tit.envs.spaces import categories_spec


class ActionWriter:
    """Converts actions from tensordicts for a vector of Gymnasium tasks.

    Args:
        space: The space of one task's actions.
        clip: Whether continuous actions are clipped to their bounds, and their spec has none.

    Raises:
        ValueError: If the actions are of a kind that is not supported.

    Example:
        >>> write = ActionWriter(Discrete(3, start=-1), clip=True)
        >>> write.spec.space.n, write(np.array([0, 2]))
        (3, array([-1,  1]))
    """

    def __init__(self, space: Space, *, clip: bool) -> None:
        self._start: int | NDArray | None = None
        self._bounds: tuple[NDArray, NDArray] | None = None
        # Of a task's action, where they are not those of the spec:
        self._shape: tuple[int, ...] | None = None
        self._dtype: np.dtype | None = None
        if isinstance(space, Discrete):
            self.spec: TensorSpec = Categorical(int(space.n), dtype=torch.int64)
            self._start = int(space.start) or None
        elif isinstance(space, MultiDiscrete):
            self.spec = categories_spec(space.nvec.flatten().tolist())
            self._start = space.start.flatten() if space.start.any() else None
        elif isinstance(space, MultiBinary):
            size = int(np.prod(space.shape))
            self.spec = Binary(size, shape=(size,), dtype=torch.int8)
        elif isinstance(space, Box) and space.dtype.kind in "fiu":
            low, high = (np.asarray(x).reshape(-1) for x in (space.low, space.high))
            self._bounds = (low, high) if clip else None
            self.spec = box_action_spec(low, high, clip=clip)
            if space.dtype.kind != "f":
                self._dtype = space.dtype
        else:
            raise ValueError(
                f"Actions of the kind {space} are not supported, only Discrete, MultiDiscrete, "
                "MultiBinary and Box; a wrapper of the task can convert them."
            )
        if self.spec.shape != space.shape:
            self._shape = space.shape

    def __call__(self, actions: NDArray) -> NDArray:
        """Converts actions [N, *spec] to those of the tasks, [N, *space]."""
        if self._bounds is not None:
            actions = actions.clip(*self._bounds)
        if self._start is not None:
            actions = actions + self._start
        if self._dtype is not None:
            actions = np.rint(actions).astype(self._dtype)
        return actions if self._shape is None else actions.reshape(len(actions), *self._shape)


def box_action_spec(low: NDArray, high: NDArray, *, clip: bool) -> TensorSpec:
    """The spec of continuous actions; float32 [A]. The bounds are [A]."""
    if clip:
        return Unbounded(low.shape, dtype=torch.float32)
    bounds = [torch.from_numpy(bound.astype(np.float32)) for bound in (low, high)]
    return Bounded(*bounds, low.shape, dtype=torch.float32)
