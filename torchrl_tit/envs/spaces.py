"""Converts Gymnasium's observation spaces and values to TorchRL's specs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple
from numpy.typing import NDArray
from tensordict import NestedKey
from torchrl.data import Categorical, Composite, MultiCategorical, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_tit.envs.action_masks import MASK
from torchrl_tit.modules.action_specs import describe
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import ImageLayout
from torchrl_tit.transforms.history import keys_of_histories, observation_ndim

_MAX_CHANNELS = 4
_MAX_ORDER = 3  # of an observation: channels, height, width


@dataclass(frozen=True)
class Leaf:
    """One observation of a task.

    Args:
        path: keys and indices that lead to it in the task's return value.
        spec: one of the kinds that :func:`observation_specs` lists, without batch dimensions.
        channels_last: whether the task's images are (height, width, channels).
        start: the integer from which the task's categories are counted, for each or one for all.
    """

    path: tuple[str | int, ...]
    spec: TensorSpec
    channels_last: bool = False
    start: Any = 0

    def read(self, values: NDArray) -> NDArray:
        """Converts the task's values to the spec's shape and dtype.

        Args:
            values: observations of N copies, [N, *space]; they are copied.

        Returns:
            The observations, [N, *spec].
        """
        if isinstance(self.spec, MultiCategorical):
            values = np.asarray(values).reshape(len(values), -1)
            return np.subtract(values, self.start, dtype=np.int64)
        if self.channels_last:
            values = np.moveaxis(values, -1, 1)
        dtype = np.uint8 if self.spec.dtype is torch.uint8 else np.float32
        copied = np.array(values, dtype, order="C")
        return copied if copied.ndim > 1 else copied[:, None]


class ObservationReader:
    """Reads the observations that a vector of Gymnasium tasks returns.

    Args:
        space: the observation space of one task.
        keys: names of the observations to keep, or of groups of them; if empty, all.
        image_layout: order of the dimensions of the task's images: ``"HWC"`` (height, width,
            channels), ``"CHW"``, or ``"auto"``, which infers it from the shape.
        mask_actions: whether "action_mask" is the mask of the actions instead of an observation.

    Raises:
        ValueError: if no observation is of a supported kind, or one of ``keys`` is not; if a key is
            unknown; or if the layout of an image cannot be inferred.

    Example:
        >>> space = Dict(camera=Box(0, 255, (84, 84, 3), np.uint8), gear=Discrete(5))
        >>> reader = ObservationReader(space)
        >>> {name: tuple(leaf.spec.shape) for name, leaf in reader.leaves.items()}
        {'camera': (3, 84, 84), 'gear': (1,)}
    """

    @checked_arguments
    def __init__(
        self,
        space: Space,
        *,
        keys: Sequence[str] = (),
        image_layout: ImageLayout = "auto",
        mask_actions: bool = False,
    ) -> None:
        found = by_name(_leaf_spaces(space))
        masks = [name for name in found if mask_actions and _belongs(name, MASK)]
        self._mask_paths = [found.pop(name)[0] for name in masks]
        self.leaves = {
            name: _leaf(name, path, part, image_layout)
            for name, (path, part) in choose(found, keys, _is_supported).items()
        }
        """The observations by their names."""
        self._only = next(iter(self.leaves.values())) if len(self.leaves) == 1 else None

    @property
    def spec(self) -> TensorSpec:
        """The spec of the only observation, or a `Composite` of all."""
        return group({name: leaf.spec for name, leaf in self.leaves.items()})

    def __call__(self, values: Any) -> NDArray | dict[str, NDArray]:
        """Reads the observations.

        Args:
            values: the observations that the vector of N tasks returned.

        Returns:
            The only observation [N, *obs], or each by its name; none shares memory with ``values``.
        """
        if self._only is not None:
            return self._only.read(_follow(self._only.path, values))
        return {name: leaf.read(_follow(leaf.path, values)) for name, leaf in self.leaves.items()}

    def masks(self, values: Any) -> list[Any]:
        """Returns the action masks among the observations, [N, ...] each."""
        return [_follow(path, values) for path in self._mask_paths]


def observation_specs(env: EnvBase) -> TensorSpec | dict[str, TensorSpec]:
    """Returns the specs of an environment's observations, for building networks.

    Their kinds are

    ===========  ==================================================================================
    array        `Unbounded` [D], float32 or uint8
    image        `Unbounded` [H, W] or [C, H, W], float32 or uint8
    categories   `MultiCategorical` [A], int64: Discrete (A = 1), MultiDiscrete and MultiBinary
    ===========  ==================================================================================

    Args:
        env: an environment of :func:`~torchrl_tit.envs.make_env`; any with a
            :class:`~torchrl_tit.transforms.History` of each observation that is read; or any whose
            observations are under "observation".

    Returns:
        The spec of the only observation; or, if there are several, the spec of each by its name:
        the key of its history is ``("history", NAME)``. The specs have no batch dimensions, and no
        dimension of agents.

    Raises:
        ValueError: if the environment has no such observations.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_tit import History
        >>> from torchrl_tit.envs import make_env
        >>> observation_specs(TransformedEnv(GymEnv("CartPole-v1"), History(4))).shape
        torch.Size([4])
        >>> list(observation_specs(make_env("Blackjack-v1")))
        ['0', '1', '2']
    """
    specs, keys = env.observation_spec_unbatched, _keys_of_histories(env)
    found = {history: _without_group(key, specs) for history, key in keys.items()}
    named = [key for key in found if isinstance(key, tuple) and key[0] == "history"]
    if named and len(named) == len(found):
        return {"/".join(history[1:]): spec for history, spec in found.items()}
    if len(set(keys.values())) > 1:
        raise ValueError(
            f"the histories {list(keys)} have no names: call them ('history', NAME), as History "
            "does by default, or build each network from the spec of its own observation"
        )
    return next(iter(found.values()))


def observation_keys(env: EnvBase) -> list[NestedKey]:
    """Returns the keys of an environment's observations, in the order of their specs.

    Args:
        env: see :func:`observation_specs`.

    Raises:
        ValueError: if the environment has no such observations.

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> observation_keys(make_env("CartPole-v1"))
        ['observation']
        >>> observation_keys(make_env("Blackjack-v1"))
        [('observation', '0'), ('observation', '1'), ('observation', '2')]
    """
    return list(dict.fromkeys(_keys_of_histories(env).values()))


def _keys_of_histories(env: EnvBase) -> dict[NestedKey, NestedKey]:
    """The key of each history's observation; without any `History`, those of "observation"."""
    if keys := keys_of_histories(env):
        return keys
    specs = env.observation_spec_unbatched
    if "observation" not in specs.keys():  # noqa: SIM118 (a Composite)
        raise ValueError(
            "the environment has no 'observation' and no History of another one, only "
            f"{', '.join(sorted(map(str, specs.keys(True, True))))}: add "
            "History(num_frames, in_keys=[...]) around the environment, with those that are read"
        )
    spec = specs["observation"]
    if not isinstance(spec, Composite):
        return {"history": "observation"}
    return {("history", name): ("observation", name) for name in spec.keys()}  # noqa: SIM118


def _without_group(key: NestedKey, specs: Composite) -> TensorSpec:
    """The spec of an observation without the dimensions of its group, such as those of agents."""
    spec = specs[key]
    for _ in range(spec.ndim - observation_ndim(key, specs)):
        spec = spec[0]
    return spec


def group(specs: dict[str, TensorSpec]) -> TensorSpec:
    """Returns the only spec, or a `Composite` of several."""
    return next(iter(specs.values())) if len(specs) == 1 else Composite(specs)


def end_flags(*batch: int) -> Composite:
    """The specs of "done", "terminated" and "truncated", bool [*batch, 1] each."""
    flag = Categorical(2, shape=(*batch, 1), dtype=torch.bool)
    names = ("done", "terminated", "truncated")
    return Composite({name: flag.clone() for name in names}, shape=batch)


def array_spec(
    name: str, shape: Sequence[int], dtype: torch.dtype, layout: ImageLayout
) -> tuple[Unbounded, bool]:
    """The spec of an array or an image, and whether the task's channels come last.

    Raises:
        ValueError: if it has more than three dimensions, or the channel dimension of an image
            cannot be inferred.
    """
    if len(shape) > _MAX_ORDER:
        raise ValueError(
            f"Observation {name!r} has the shape {list(shape)}, but at most {_MAX_ORDER} "
            "dimensions are supported: flatten it with the wrapper "
            "gymnasium.wrappers:FlattenObservation, or leave the stacking of frames to the history."
        )
    last = len(shape) == _MAX_ORDER and _channels_last(name, shape, layout)
    if last:
        shape = (shape[-1], *shape[:-1])
    dtype = dtype if dtype is torch.uint8 else torch.float32
    return Unbounded(torch.Size(shape or (1,)), dtype=dtype), last


def choose(
    found: dict[str, tuple[Any, Any]],
    keys: Sequence[str],
    supported: Callable[[tuple[Any, Any]], Any],
) -> dict[str, tuple[Any, Any]]:
    """Chooses the observations to read.

    Args:
        found: the task's observations by name: the path, and the space or spec.
        keys: names, or prefixes of names before "/"; if empty, all.
        supported: returns whether a value of ``found`` is of a supported kind.

    Returns:
        The chosen observations, in the task's order. If there are no keys, unsupported ones are
        left out with a warning.

    Raises:
        ValueError: if a key is unknown or of an unsupported kind, or nothing is left.
    """
    for key in keys:
        if not any(_belongs(name, key) for name in found):
            raise ValueError(
                f"The task has no observation {key!r}, which observation_keys names, only "
                f"{', '.join(found)}."
            )
    chosen = {
        name: value
        for name, value in found.items()
        if not keys or any(_belongs(name, key) for key in keys)
    }
    left_out = {name: value for name, value in chosen.items() if not supported(value)}
    kept = {name: value for name, value in chosen.items() if name not in left_out}
    described = ", ".join(f"{name!r} ({describe(value[1])})" for name, value in left_out.items())
    if not kept or (keys and left_out):
        raise ValueError(
            f"Observations of this kind are not supported: {described or 'none at all'}. Supported "
            "are Box, Discrete, MultiDiscrete and MultiBinary, and Dict and Tuple of these."
        )
    if left_out:
        warnings.warn(
            f"The observation {described} is left out, since its kind is not supported; "
            f"`--observation-keys {' '.join(kept)}` says so without a warning.",
            stacklevel=2,
        )
    return kept


def only_space(space: Space, keys: Sequence[str] = ()) -> Space:
    """Returns the space of the one observation that is read, or the whole space if there are more.

    Args:
        space: the observation space of a task.
        keys: names of the observations to keep; if empty, all.

    Raises:
        ValueError: if a key is unknown, or an observation is of an unsupported kind.

    Example:
        >>> only_space(Dict(camera=Box(0, 255, (84, 84, 3), np.uint8), gear=Discrete(5)), ["gear"])
        Discrete(5)
        >>> only_space(Dict(gear=Discrete(5)))
        Discrete(5)
    """
    if not keys and not isinstance(space, Dict | Tuple):
        return space
    found = choose(by_name(_leaf_spaces(space)), keys, _is_supported)
    chosen = [part for _, part in found.values()]
    return chosen[0] if len(chosen) == 1 else space


def leaf_name(keys: Iterable[str]) -> str:
    """The name of a nested observation, without dots, which names of modules cannot have."""
    return "/".join(keys).replace(".", "_")


ValueT = TypeVar("ValueT")


def by_name(observations: Iterable[tuple[str, ValueT]]) -> dict[str, ValueT]:
    """Makes a dictionary of observations, and raises ValueError if two have one name."""
    found: dict[str, ValueT] = {}
    for name, value in observations:
        if name in found:
            raise ValueError(
                f'The task has two observations with the name "{name}" (a dot in a name becomes '
                '"_", and levels are joined by "/"): rename one of them.'
            )
        found[name] = value
    return found


def _leaf_spaces(
    space: Space, path: tuple[str | int, ...] = ()
) -> Iterator[tuple[str, tuple[tuple[str | int, ...], Space]]]:
    """Yields the name of each leaf of a nested space, with its path and its own space."""
    if isinstance(space, Dict | Tuple):
        parts = space.items() if isinstance(space, Dict) else enumerate(space)
        for key, part in parts:
            yield from _leaf_spaces(part, (*path, key))
    else:
        yield leaf_name(map(str, path)) or "observation", (path, space)


def _follow(path: tuple[str | int, ...], values: Any) -> Any:
    for key in path:
        values = values[key]
    return values


def _is_supported(found: tuple[Any, Space]) -> bool:
    space = found[1]
    if isinstance(space, Box):
        return space.dtype.kind in "fiub"
    return isinstance(space, Discrete | MultiDiscrete | MultiBinary)


def _leaf(name: str, path: tuple[str | int, ...], space: Space, layout: ImageLayout) -> Leaf:
    if isinstance(space, Discrete):
        return Leaf(path, MultiCategorical([int(space.n)]), start=int(space.start))
    if isinstance(space, MultiDiscrete):
        return Leaf(
            path, MultiCategorical(space.nvec.flatten().tolist()), start=space.start.flatten()
        )
    if isinstance(space, MultiBinary):
        return Leaf(path, MultiCategorical([2] * int(np.prod(space.shape))))
    assert space.shape is not None  # a Box
    dtype = torch.uint8 if space.dtype == np.uint8 else torch.float32
    spec, channels_last = array_spec(name, space.shape, dtype, layout)
    return Leaf(path, spec, channels_last)


def _channels_last(name: str, shape: Sequence[int], layout: ImageLayout) -> bool:
    if layout != "auto":
        return layout == "HWC"
    first, last = (0 < side <= _MAX_CHANNELS for side in (shape[0], shape[-1]))
    if first == last:
        raise ValueError(
            f"Observation {name!r} is an image of shape {list(shape)}, and it is not clear whether "
            "its channels come first or last: say so with `--image-layout HWC` or "
            "`--image-layout CHW`."
        )
    return last


def _belongs(name: str, key: str) -> bool:
    return name == key or name.startswith(f"{key}/")
