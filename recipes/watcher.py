"""Looking on while an agent is trained."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase


class Watcher(Protocol):
    """What a training loop shows its work to."""

    def collected(self, step: int, batch: TensorDictBase) -> None:
        """Sees the steps that the agent took, before it is trained on them.

        Args:
            step: environment steps until the batch's end.
            batch: [envs, time], with the task's own rewards. Not to be changed.
        """

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        """Sees the agent after an update.

        Args:
            step: environment steps so far.
            policy: the agent's policy. Not to be changed.

        Returns:
            Whether that is enough: the loop then saves a checkpoint and ends.
        """


class RecallingWatcher(Watcher, Protocol):
    """One that also keeps what it was shown, for algorithms that train on all of it."""

    def recall(self, step: int) -> Iterator[TensorDictBase]:
        """Gives back what was collected.

        Args:
            step: environment steps up to which it is wanted.

        Yields:
            The batches one after the other, each [envs, time].
        """
