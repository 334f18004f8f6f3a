"""Partially observable variants of tasks, without velocities."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.transforms import ObservationTransform

VELOCITIES: dict[str, list[int]] = {
    "CartPole": [1, 3],
    "Acrobot": [4, 5],
    "MountainCar": [1],
    "Pendulum": [2],
    "Hopper": list(range(5, 11)),
    "Walker2d": list(range(8, 17)),
    "HalfCheetah": list(range(8, 17)),
}
"""Indices of the velocities in an observation, by the task's name without its version."""


class HideEntries(ObservationTransform):
    """Removes entries from an observation's last dimension, as if sensors were missing.

    It commutes with :class:`~torchrl_tit.transforms.History`: put it before `History`, or after it
    for both keys.

    Args:
        hidden: indices of the entries to remove.
        in_keys: list of keys of the observations, which may be nested. One of shape [..., D]
            becomes [..., D - len(hidden)].

    Raises:
        ValueError: if ``hidden`` names an entry twice; or, when the specs of an environment with
            the transform are read, if it names an entry that does not exist, or all entries.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), HideEntries([1, 3]))
        >>> env.reset()["observation"].shape
        torch.Size([2])
    """

    def __init__(
        self, hidden: Sequence[int], in_keys: Sequence[NestedKey] = ("observation",)
    ) -> None:
        if len(set(hidden)) < len(hidden):
            raise ValueError(f"Each entry can be hidden only once, but hidden is {list(hidden)}.")
        super().__init__(in_keys=list(in_keys), out_keys=list(in_keys))
        self.hidden = list(hidden)
        """Indices of the entries that are removed."""

    def _apply_transform(self, observation: Tensor) -> Tensor:
        return observation[..., self._seen(observation.shape[-1])]

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Removes the entries from the specs.

        Args:
            observation_spec: the specs before this transform.

        Returns:
            The same specs, with fewer entries under ``in_keys``.

        Raises:
            ValueError: if an entry to hide does not exist, or none would be left.
        """
        for key in self.in_keys:
            spec = observation_spec[key]
            observation_spec[key] = spec[..., self._seen(spec.shape[-1])]
        return observation_spec

    def _seen(self, size: int) -> list[int]:
        """Returns the indices of the entries that are left."""
        seen = [i for i in range(size) if i not in self.hidden]
        if not seen or len(seen) + len(self.hidden) != size:
            raise ValueError(
                f"An observation has the entries 0 to {size - 1}, and one must be left, so "
                f"{self.hidden} cannot be hidden."
            )
        return seen


class HideVelocities(HideEntries):
    """Removes the velocities from a task's observations, so that one alone is not enough to act on.

    The velocities can be inferred from several observations, so a history makes up for them.

    Args:
        task: name of the task, with or without its version, such as "CartPole-v1" or "Hopper".
        in_keys: see :class:`HideEntries`.

    Raises:
        ValueError: if the velocities of this task are unknown, or if, when the specs of an
            environment with the transform are read, a setting of the task has added entries; use
            :class:`HideEntries` instead.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_tit.transforms import History
        >>> env = TransformedEnv(GymEnv("Acrobot-v1"), HideVelocities("Acrobot-v1"))
        >>> env.append_transform(History(num_frames=8)).reset()["history"].shape
        torch.Size([8, 4])
    """

    def __init__(self, task: str, in_keys: Sequence[NestedKey] = ("observation",)) -> None:
        name = task.split("-v")[0]
        if name not in VELOCITIES:
            raise ValueError(
                f"It is not known which observations of {task!r} are velocities, only of "
                f"{', '.join(VELOCITIES)}; use HideEntries with the indices of the velocities."
            )
        super().__init__(VELOCITIES[name], in_keys)
        self._task = task

    def _seen(self, size: int) -> list[int]:
        # In every one of these tasks the last entry is a velocity.
        if size - 1 != self.hidden[-1]:
            raise ValueError(
                f"An observation of {self._task!r} has {self.hidden[-1] + 1} entries, not {size}; "
                "use HideEntries with the indices of the velocities."
            )
        return super()._seen(size)
