"""What every recipe has, and recipes as JSON."""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
import torch
import tyro

from .networks import NETWORKS, NetworkConfig

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase
    from torchrl.envs import EnvBase

    from .run import Run

ALGORITHMS: dict[str, type[Recipe]] = {}
"""Recipe classes by the name of their algorithm."""

T = TypeVar("T")

# NumPy takes 32 bits, and environments are seeded with this seed and those that follow.
_MAX_SEED = 2**31


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings that every experiment has."""

    algorithm: ClassVar[str]
    offline: ClassVar[bool] = False
    """Whether steps are gradient steps, and returns those of evaluations."""
    trains_side_by_side: ClassVar[bool] = False
    """Whether several seeds can be trained in one process; see :meth:`train_side_by_side`."""

    name: Annotated[str, tyro.conf.Suppress] = ""
    """The recipe's name, such as ppo/cartpole/enhanced-tit."""
    backbone: NetworkConfig
    """The network, one of those in recipes/networks.py, and its hyperparameters."""
    seed: int = 0
    """Seed of the networks, the environments and the update's order."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where the networks are: "auto" is the GPU where there is one."""
    threads: int = 1
    """PyTorch's threads on the CPU; small networks run fastest on one."""
    evaluation_episodes: int = 100
    """Episodes of an evaluation."""
    evaluation_seed: int = 1_000_000
    """Seed of the first evaluation episode; the others follow one by one."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "algorithm" in vars(cls):  # not what several recipes share
            ALGORITHMS[cls.algorithm] = cls

    def __post_init__(self) -> None:
        if not isinstance(self.backbone, NetworkConfig):
            raise ValueError(
                f"field 'backbone' must be the settings of a network, such as MLPConfig(), not "
                f"{self.backbone!r}"
            )
        for name, kind in _field_types(type(self)).items():  # type: ignore[arg-type]
            if name != "backbone":  # which algorithm takes which network, it says itself
                _checked(name, getattr(self, name), kind)
        check_at_least(self, threads=1, seed=0, evaluation_episodes=1, evaluation_seed=0)
        check_at_most(self, seed=_MAX_SEED, evaluation_seed=_MAX_SEED)
        if self.name and not re.fullmatch(r"\w[\w.-]*(/\w[\w.-]*)*", self.name):
            raise ValueError(
                f"name must be words joined by '/', such as ppo/cartpole/mine, not {self.name!r}"
            )

    @property
    def final_step(self) -> int:
        """Environment steps, or updates, at which training is complete."""
        raise NotImplementedError

    def check(self) -> None:
        """Raises ValueError where environment or networks cannot be built as the fields say."""
        raise NotImplementedError

    def train(self, run: Run) -> None:
        """Trains in a run folder, from its newest checkpoint where there is one."""
        raise NotImplementedError

    def train_side_by_side(self, runs: Sequence[Run]) -> None:
        """Trains runs whose recipes are this one with seeds of their own, all at once."""
        raise NotImplementedError

    def evaluate(self, run: Run) -> dict[str, Any]:
        """Evaluates a run's newest checkpoint and returns what ``evaluation.json`` is to hold."""
        raise NotImplementedError

    def load_player(self, run: Run, **settings: Any) -> tuple[TensorDictModuleBase, EnvBase]:
        """Loads the policy of a run's newest checkpoint, in evaluation mode, and one environment.

        Args:
            run: a run folder with a checkpoint.
            **settings: of the task, such as ``render_mode="rgb_array"``.

        Raises:
            FileNotFoundError: if there is no checkpoint.
        """
        raise NotImplementedError

    def torch_device(self) -> torch.device:
        """The device that ``device`` names on this machine.

        Raises:
            ValueError: if there is no such device.
        """
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device is 'cuda', but PyTorch finds no GPU: use 'cpu' or 'auto'")
        if self.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.device)


def check_at_least(recipe: object, **minima: float) -> None:
    """Raises ValueError where a field of a recipe is below its minimum."""
    for field, minimum in minima.items():
        value = getattr(recipe, field)
        if not value >= minimum:
            raise ValueError(f"{field} must be at least {minimum}, not {value}")


def check_at_most(recipe: object, **maxima: float) -> None:
    """Raises ValueError where a field of a recipe is above its maximum."""
    for field, maximum in maxima.items():
        value = getattr(recipe, field)
        if not value <= maximum:
            raise ValueError(f"{field} must be at most {maximum}, not {value}")


def recipe_to_json(recipe: Recipe) -> str:
    """Writes a recipe as JSON, from which :func:`recipe_from_json` makes it again."""
    network = next(name for name, (kind, _) in NETWORKS.items() if kind is type(recipe.backbone))
    fields = dataclasses.asdict(recipe)
    fields["backbone"] = {"network": network, **fields["backbone"]}
    return json.dumps({"algorithm": recipe.algorithm, **fields}, indent=2) + "\n"


def recipe_from_json(text: str | bytes, source: str | Path) -> Recipe:
    """Makes a recipe from JSON.

    Args:
        text: what :func:`recipe_to_json` wrote; fields that are missing take their defaults.
        source: the file it came from, for messages.

    Raises:
        ValueError: if it is no JSON, a field is unknown or has the wrong type or value.
    """
    from . import registry  # noqa: F401  imports, and so registers, every algorithm

    try:
        fields = json.loads(text)
        if not isinstance(fields, dict):
            raise ValueError("expected an object with the recipe's fields")
        recipe = _take(fields, "algorithm", ALGORITHMS)
        backbone = fields.get("backbone", {})
        if not isinstance(backbone, dict):
            raise ValueError(f"field 'backbone': expected an object, not {backbone!r}")
        network = _take(backbone, "network", {name: kind for name, (kind, _) in NETWORKS.items()})
        return _convert(recipe, fields, backbone=_convert(network, backbone, "backbone."))
    except (RecursionError, ValueError) as error:  # json.JSONDecodeError is one
        raise ValueError(f"{source} is not a recipe: {error}") from error


def nearest(name: str, names: Mapping[str, object]) -> str:
    """Words for an error message: the names nearest to an unknown one."""
    matches = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
    return f"did you mean {' or '.join(matches)}?" if matches else f"choose from {', '.join(names)}"


def _take(fields: dict[str, Any], key: str, choices: Mapping[str, T]) -> T:
    """Removes the entry that says what the fields belong to and looks it up."""
    name = fields.pop(key, None)
    if name not in choices:
        raise ValueError(f"unknown {key} {name!r}: {nearest(str(name), choices)}")
    return choices[name]


def _convert(kind: type[T], fields: dict[str, Any], prefix: str = "", **made: Any) -> T:
    """Builds a dataclass from fields, each strictly of its type; ``made`` are built already."""
    types = _field_types(kind)  # type: ignore[arg-type]
    values = dict(made)
    for name, value in fields.items():
        if name not in types:
            raise ValueError(f"unknown field {prefix + name!r}: {nearest(name, types)}")
        if name not in made:
            values[name] = _checked(prefix + name, value, types[name])
    return kind(**values)


@cache
def _field_types(kind: type) -> dict[str, Any]:
    """The fields of a dataclass with their types."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _checked(name: str, value: object, kind: Any) -> Any:
    """Returns a value as its type, or raises ValueError where it is of another."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        choices = f", not one of {get_args(kind)}" if get_origin(kind) is Literal else ""
        raise ValueError(f"field {name!r} is {value!r}{choices}: {error}") from error
