"""Callbacks of the training loop."""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictModuleBase


class Callback:
    """Hooks that the training loop calls; by default they do nothing."""

    def collected(self, step: int, batch: Any) -> None:
        """Called with each batch, before the update.

        Args:
            step: number of steps at the end of the batch.
            batch: what the algorithm's ``batches`` yielded; do not modify it. An online batch is a
                tensordict [envs, time] with unclipped rewards.
        """

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        """Called with the policy after each update.

        Args:
            step: number of steps so far.
            policy: the policy; do not modify it.

        Returns:
            Whether to end training: the loop then saves a checkpoint and returns.
        """
        return False

    def saving(self, step: int) -> None:
        """Called before a checkpoint is saved, to write other files that a resumed run needs.

        Args:
            step: number of steps so far, which is the checkpoint's number.
        """
