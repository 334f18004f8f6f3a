"""Which actions a Gymnasium task allows."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete, Space
from numpy.typing import NDArray

MASK = "action_mask"
"""Key of the mask, in a tensordict and in Gymnasium's observations or info."""


class ActionMasks:
    """The masks of N copies of a task, from observations or from `info`.

    Args:
        num_envs: N.
        space: the action space of one task.

    Raises:
        ValueError: if actions of that kind cannot be masked.

    Example:
        >>> masks = ActionMasks(2, Discrete(3))
        >>> info = {"action_mask": np.array([[1, 0, 1], [0, 0, 0]]), "_action_mask": [True, False]}
        >>> masks.from_info(info)  # the second copy reported nothing
        array([[ True, False,  True],
               [ True,  True,  True]])
    """

    def __init__(self, num_envs: int, space: Space) -> None:
        if isinstance(space, Discrete):
            size = int(space.n)
        elif isinstance(space, MultiDiscrete):
            size = int(space.nvec.sum())
        else:
            raise ValueError(
                f"Only Discrete and MultiDiscrete actions can be masked, but these are {space}: "
                "leave out mask_actions."
            )
        self.shape = (num_envs, size)
        self._masks = np.ones(self.shape, bool)

    def from_observations(self, parts: list[Any]) -> NDArray:
        """Reads the masks in observations; bool [N, size].

        Args:
            parts: [N, ...] each, such as one for each entry of a MultiDiscrete action.
        """
        flat = [np.asarray(part).reshape(self.shape[0], -1) for part in parts]
        return self._check(np.concatenate(flat, 1).astype(bool))

    def from_info(self, info: dict[str, Any]) -> NDArray:
        """Reads the masks in a vector environment's info; bool [N, size].

        Copies that report nothing, such as those that are not reset, keep their last mask.
        """
        masks = self._masks.copy()
        for i in np.flatnonzero(info.get(f"_{MASK}", ())):
            mask = info[MASK][i]
            parts = mask if isinstance(mask, tuple | list) else [mask]
            flat = np.concatenate([np.ravel(part) for part in parts]).astype(bool)
            masks[i] = self._check(flat)
        self._masks = masks
        return masks.copy()

    def _check(self, masks: NDArray) -> NDArray:
        if masks.shape[-1] != self.shape[-1]:
            raise ValueError(
                f'The task\'s "{MASK}" has {masks.shape[-1]} entries, but there are '
                f"{self.shape[-1]} actions to allow or not."
            )
        return masks
