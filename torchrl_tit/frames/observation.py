"""Descriptions of the observations that networks read: shapes, and numbers of categories."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import torch
from torchrl.data import Categorical, Composite, MultiCategorical, TensorSpec

Kind = Literal["array", "image", "categories"]
"""Kinds of observations: (D,), (H, W) or (C, H, W), and integers that count from 0."""

ObservationLike: TypeAlias = "Sequence[int] | TensorSpec | Observation"
"""An observation: its shape, or TorchRL's unbatched spec of it."""

Observations: TypeAlias = "ObservationLike | Mapping[str, ObservationLike]"
"""One observation, or several by name."""


@dataclass(frozen=True)
class Observation:
    """An observation as a frame encoder sees it.

    Raises:
        ValueError: if it is neither an array, nor an image, nor a row of categories.

    Example:
        >>> Observation((3, 84, 84)).kind
        'image'
        >>> Observation((2,), categories=(4, 3)).entries
        7
    """

    shape: tuple[int, ...]
    """(D,) for arrays and categories, (H, W) or (C, H, W) for images."""
    categories: tuple[int, ...] | None = None
    """For categories, the number of values of each of the D entries."""
    dtype: torch.dtype | None = None
    """The dtype, if known from a spec."""

    def __post_init__(self) -> None:
        check_observation_shape(self.shape)
        if self.categories is not None and self.shape != (len(self.categories),):
            raise ValueError(
                f"categories {self.categories} are an observation of shape "
                f"{(len(self.categories),)}, not {self.shape}"
            )

    @property
    def kind(self) -> Kind:
        """The kind of observation."""
        if self.categories is not None:
            return "categories"
        return "array" if len(self.shape) == 1 else "image"

    @property
    def entries(self) -> int:
        """Number of entries; for categories, of all their one-hot vectors."""
        return math.prod(self.shape) if self.categories is None else sum(self.categories)

    def zeros(self, *leading: int) -> torch.Tensor:
        """Returns observations of zeros, [*leading, *shape], with a dtype that networks read."""
        dtype = torch.int64 if self.categories is not None else self.dtype
        return torch.zeros(*leading, *self.shape, dtype=dtype)

    def draw(self, *leading: int) -> torch.Tensor:
        """Draws observations like :meth:`zeros`: floats from 0 to 1, any bytes and categories."""
        drawn, dtype = torch.rand(*leading, *self.shape), self.zeros().dtype
        if self.categories is not None:
            drawn = drawn * torch.tensor(self.categories)
        elif dtype == torch.uint8:
            drawn = drawn * 256
        return drawn.to(dtype)

    def __str__(self) -> str:
        """Describes it for error messages, such as "an image of shape (3, 7, 7)"."""
        if self.categories is not None:
            counts = ", ".join(map(str, self.categories))
            return f"a row of categories ({counts} values)"
        return f"{'an array' if self.kind == 'array' else 'an image'} of shape {self.shape}"


def read_observation(observation: ObservationLike) -> Observation:
    """Describes one observation.

    Args:
        observation: its shape, or its spec without batch dimensions. For categories, the spec is
            TorchRL's `MultiCategorical` [D], or a `Categorical` or `Binary` of that shape.

    Raises:
        ValueError: if networks cannot read it.

    Example:
        >>> read_observation(MultiCategorical([4, 3])).categories
        (4, 3)
        >>> read_observation((84, 84)).kind
        'image'
    """
    if isinstance(observation, Observation):
        return observation
    if not isinstance(observation, TensorSpec):
        return Observation(check_observation_shape(observation))
    shape, dtype = tuple(observation.shape), observation.dtype
    categories = _categories(observation)
    if categories is None and not (dtype.is_floating_point or dtype == torch.uint8):
        raise ValueError(
            f"observations of {dtype} are neither floats nor bytes nor categories: convert them "
            "(TorchRL's DTypeCastTransform), or give them a MultiCategorical spec"
        )
    return Observation(check_observation_shape(shape), categories, dtype)


def read_observations(observations: Observations) -> dict[str, Observation]:
    """Describes observations by name; a single one is called "observation".

    Args:
        observations: one, or several by name; from a `Composite` spec, the leaves are taken, whose
            names are joined by "/".

    Raises:
        ValueError: if there are none, or networks cannot read one; the message names it.

    Example:
        >>> list(read_observations((4,)))
        ['observation']
        >>> task = {"pixels": (3, 84, 84), "direction": MultiCategorical([4])}
        >>> [(name, seen.kind) for name, seen in read_observations(task).items()]
        [('pixels', 'image'), ('direction', 'categories')]
    """
    named: dict[str, Any]
    if isinstance(observations, Composite):
        leaves = observations.items(True, True)
        named = {key if isinstance(key, str) else "/".join(key): leaf for key, leaf in leaves}
    elif isinstance(observations, Mapping):
        named = dict(observations)
    else:
        return {"observation": read_observation(observations)}
    if not named:
        raise ValueError("there are no observations to read")
    read = {}
    for name, observation in named.items():
        try:
            read[name] = read_observation(observation)
        except ValueError as error:
            raise ValueError(f"observation {name!r}: {error}") from error
    return read


def check_observation_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """Returns the shape of an observation as a tuple.

    Raises:
        ValueError: if it is neither the shape of an array nor that of an image.
    """
    if (
        not isinstance(shape, Sequence)
        or len(shape) not in (1, 2, 3)
        or not all(isinstance(size, int) and size > 0 for size in shape)
    ):
        raise ValueError(
            f"observation_shape {shape!r} is not that of an array (D,) or an image (H, W) or "
            "(C, H, W)"
        )
    return tuple(shape)


def _categories(spec: TensorSpec) -> tuple[int, ...] | None:
    """Numbers of values of a row of categories; None for other specs."""
    if not isinstance(spec, Categorical) or spec.ndim != 1:
        return None
    if isinstance(spec, MultiCategorical):
        return tuple(spec.nvec.tolist())
    return (int(spec.n),) * spec.shape[0]  # Binary is also a Categorical
