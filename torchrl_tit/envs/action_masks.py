"""Which actions a Gymnasium task allows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete, Space
from numpy.typing import NDArray

MASK = "action_mask"
"""Key of the mask, in a tensordict and in Gymnasium's observations or info."""


def check_allowed(masks: NDArray, ended: NDArray, sizes: Sequence[int]) -> None:
    """Checks that every copy that goes on has an action to take.

    Args:
        masks: the allowed options of all entries of an action; bool [..., sum(sizes)].
        ended: where the episode has ended, so that no action is needed; bool [...].
        sizes: number of options of each entry.

    Raises:
        ValueError: if an entry has no allowed option.

    Example:
        >>> check_allowed(np.array([[True, False], [False, False]]), np.array([False, True]), [2])
    """
    possible = np.logical_or.reduceat(masks, np.cumsum([0, *sizes[:-1]]), -1).all(-1)
    if not (possible | ended).all():
        raise ValueError(
            f'The task\'s "{MASK}" allows no action, though the episode goes on: let it allow one, '
            "or end the episode."
        )


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
            self.sizes = [int(space.n)]
        elif isinstance(space, MultiDiscrete):
            self.sizes = space.nvec.ravel().tolist()
        else:
            raise ValueError(
                f"Only Discrete and MultiDiscrete actions can be masked, but these are {space}: "
                "leave out mask_actions."
            )
        self.shape = (num_envs, sum(self.sizes))
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
