"""Observations as an environment writes them, and their conversion to a network's inputs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import ObservationTransform, Transform

from torchrl_tit.transforms import History, SequenceHistory
from torchrl_tit.transforms.hide_velocities import HideEntries
from torchrl_tit.windows import Padding


@dataclass(frozen=True)
class Entry:
    """A tensor that an exported policy reads or writes."""

    shape: tuple[int, ...]
    """Its shape, without the batch."""
    dtype: torch.dtype

    def zeros(self, size: int) -> Tensor:
        """Returns zeros, [size, *shape]."""
        return torch.zeros(size, *self.shape, dtype=self.dtype)


class Select(nn.Module):
    """Selects some entries of the last dimension.

    Args:
        entries: their indices.
    """

    entries: Tensor

    def __init__(self, entries: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("entries", torch.tensor(entries))

    def forward(self, observation: Tensor) -> Tensor:
        """[..., D] -> [..., entries]."""
        return observation.index_select(-1, self.entries)


@dataclass(frozen=True)
class Observed:
    """An observation of a task, before velocities are hidden."""

    name: str
    """Its name, if there are several; empty if it is the only one."""
    key: NestedKey
    """The key under which the environment writes it."""
    entry: Entry
    """Shape and dtype of one observation."""
    layers: nn.Sequential
    """The environment's operations on it before the network reads it."""
    place: int
    """Number of the environment's transforms before the first of these."""
    padding: Padding | None
    """Padding before an episode; None if it is masked."""


class Untouched(ObservationTransform):
    """Copies an observation as it is at this place among the transforms of an environment.

    Args:
        in_keys: key of the observation.
        out_keys: key of the copy.
    """

    def _apply_transform(self, observation: Tensor) -> Tensor:
        return observation.clone()

    def _reset(self, tensordict: object, tensordict_reset: object) -> object:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the spec of the copy."""
        for key, copy in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[copy] = observation_spec[key].clone()
        return observation_spec


def transforms_of(env: EnvBase) -> list[Transform]:
    """Lists the transforms of an environment, the innermost first."""
    if not isinstance(env, TransformedEnv):
        return []
    transform = env.transform
    return list(getattr(transform, "transforms", [transform]))


def trace(env: EnvBase, history_key: NestedKey, name: str = "") -> Observed:
    """Finds the observation from which a history is made.

    Args:
        env: the environment that writes it.
        history_key: its key.
        name: name of the observation, if there are several.

    Raises:
        ValueError: if no :class:`~torchrl_tit.transforms.History` writes it.

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", num_frames=4, hide_velocities=True)
        >>> seen = trace(env, "history")
        >>> seen.entry.shape, seen.layers(torch.tensor([0.0, 1.0, 2.0, 3.0]))
        ((4,), tensor([0., 2.]))
    """
    transforms = transforms_of(env)
    key, place = unravel_key(history_key), len(transforms)
    layers: list[nn.Module] = []
    padding: Padding | None = None
    stacked, size = False, None
    for index in reversed(range(len(transforms))):
        transform = transforms[index]
        outs = [unravel_key(out) for out in transform.out_keys or ()]
        if isinstance(transform, SequenceHistory):
            if key in ((out, "observation") for out in outs):
                key, stacked = unravel_key(transform.in_keys[0]), True
                place = index
            continue
        if key not in outs:
            continue
        source = unravel_key(transform.in_keys[outs.index(key)])
        if isinstance(transform, History):
            padding, stacked = transform.padding, True
        elif isinstance(transform, HideEntries):
            shape = env.observation_spec[history_key].shape
            size = shape[-1] + len(transform.hidden)
            layers.append(Select([i for i in range(size) if i not in transform.hidden]))
        else:
            break  # this one writes the observation
        key, place = source, index
    if not stacked:
        raise ValueError(
            f"no History of the environment writes {history_key!r}, so it is not known what the "
            "policy reads: make the environment with torchrl_tit.envs.make_env, or add History"
        )
    spec = env.observation_spec[history_key]
    shape = tuple(spec.shape[env.ndim + 1 :])
    if size is not None:
        shape = (*shape[:-1], size)
    entry = Entry(shape, spec.dtype)
    return Observed(name, key, entry, nn.Sequential(*reversed(layers)), place, padding)


def identifiers(names: Sequence[str]) -> list[str]:
    """Turns names into unique argument names.

    Example:
        >>> identifiers(["arm/left", "arm.left", "image"])
        ['arm_left', 'arm_left_', 'image']
    """
    made: list[str] = []
    for name in names:
        argument = re.sub(r"\W", "_", name)
        while argument in made:
            argument += "_"
        made.append(argument)
    return made
