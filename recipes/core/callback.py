"""Callbacks of the training loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase

from .evaluation import Outcome


class Callback:
    """Hooks that the training loop calls; by default they do nothing.

    For each batch, the hooks are called in the order in which they are defined here. If there are
    several callbacks, each hook is called on all of them in turn. A resumed run calls the hooks
    from the batch after its checkpoint on. An exception in a hook ends the run, as a kill would.

    Example:
        >>> class Steps(Callback):
        ...     def updated(self, step, policy):
        ...         print("step", step)
        ...         return step >= 1000  # ends training
    """

    last_step: int | None = None
    """The step by which it will end training at the latest; None if unknown."""

    def collected(self, step: int, batch: Any) -> None:
        """Called with each batch, before the update.

        Args:
            step: number of steps at the end of the batch.
            batch: what the algorithm's ``batches`` yielded; do not modify it. An online batch is a
                tensordict [envs, time] with unclipped rewards; PPO's update scales these, and adds
                ``advantage`` and ``value_target``.
        """

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool | None:
        """Called with the policy after each update.

        Args:
            step: number of steps so far.
            policy: the policy; do not modify it.

        Returns:
            Whether to end training: the loop then saves a checkpoint and returns.
        """
        return False

    def evaluated(self, step: int, outcomes: Sequence[Outcome]) -> None:
        """Called after each evaluation, including that of a complete run.

        Args:
            step: number of steps that the policy was trained for.
            outcomes: the returns of the episodes, for each target return if there are any.
        """

    def logged(self, step: int, row: Mapping[str, float]) -> None:
        """Called with each row of ``metrics.csv`` once it is written.

        Args:
            step: number of steps so far.
            row: the numbers by column; NaN means that a number does not exist at this step.
        """

    def saving(self, step: int) -> None:
        """Called before a checkpoint is saved, to write other files that a resumed run needs.

        Args:
            step: number of steps so far, which is the checkpoint's number.
        """

    def saved(self, step: int) -> None:
        """Called once a checkpoint is complete.

        Args:
            step: number of steps so far, which is the checkpoint's number.
        """
