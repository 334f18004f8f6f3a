"""Partially observable variants of tasks: the same without the velocities."""

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
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
"""The entries of an observation that are velocities, by the task's name without its version."""


class HideEntries(ObservationTransform):
    """Leaves entries out of an observation's last dimension, as if their sensors were missing.

    It commutes with :class:`~torchrl_tit.transforms.History`: hide the entries of the observation
    before its history is made, or of both afterwards.

    Args:
        hidden: Indices of the entries to leave out.
        in_keys: Keys of the observations, which may be nested. One of shape [..., D] becomes
            [..., D - len(hidden)].

    Raises:
        ValueError: If ``hidden`` names an entry twice, or, when an environment takes the transform,
            one that is not there, or all of them.

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
            raise ValueError(f"Each entry is hidden once, but hidden is {list(hidden)}.")
        super().__init__(in_keys=list(in_keys), out_keys=list(in_keys))
        self._hidden = list(hidden)

    def _apply_transform(self, observation: Tensor) -> Tensor:
        return observation[..., self._seen(observation.shape[-1])]

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """The specs of what is left.

        Args:
            observation_spec: The specs of the environment below.

        Returns:
            The same, with fewer entries under ``in_keys``.

        Raises:
            ValueError: If an entry to hide is not there, or none would be left.
        """
        for key in self.in_keys:
            observation_spec[key] = self._spec(observation_spec[key])
        return observation_spec

    def _spec(self, spec: TensorSpec) -> TensorSpec:
        seen = self._seen(spec.shape[-1])
        if isinstance(spec, Bounded):
            low, high = spec.space.low[..., seen], spec.space.high[..., seen]
            return Bounded(low, high, low.shape, dtype=spec.dtype, device=spec.device)
        return spec[..., seen]

    def _seen(self, size: int) -> list[int]:
        """The entries that are left of those of an observation."""
        seen = [i for i in range(size) if i not in self._hidden]
        if not seen or len(seen) + len(self._hidden) != size:
            raise ValueError(
                f"An observation has the entries 0 to {size - 1}, of which at least one must be "
                f"left, so {self._hidden} cannot be hidden."
            )
        return seen


class HideVelocities(HideEntries):
    """Leaves the velocities out of a task's observations, so that one says too little to act well.

    What is hidden follows from the observations before: these are the tasks that a history is for.

    Args:
        task: Name of the task, with or without its version, such as "CartPole-v1" or "Hopper".
        in_keys: See :class:`HideEntries`.

    Raises:
        ValueError: If it is not known which entries are velocities in this task, or, when an
            environment takes the transform, a setting of the task has added entries; name them to
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
                f"{', '.join(VELOCITIES)}; name the entries to HideEntries."
            )
        super().__init__(VELOCITIES[name], in_keys)
        self._task = task

    def _seen(self, size: int) -> list[int]:
        # In every one of these tasks the last entry is a velocity.
        if size - 1 != self._hidden[-1]:
            raise ValueError(
                f"An observation of {self._task!r} has {self._hidden[-1] + 1} entries, not {size}; "
                "name those that are velocities to HideEntries."
            )
        return super()._seen(size)
