"""What files of others may name: one list, which every way in asks.

A recipe in JSON can come from a stranger, alone or in the folder of a run or an agent. Whatever it
names is made and run, so it may name only tasks, wrappers and transforms of this list, with
numbers and plain words as their settings: they compute, and import, start, write and download
nothing. Whatever else it names, users allow in their own words: by ``--import MODULE``, by
installing a plugin, or by typing it. :func:`~recipes.core.recipe_json.recipe_from_json`, through
which every such recipe comes, asks.

Encoders and algorithms need no list: their names are those of registered classes. A data set is
read and never run (:mod:`torchrl_tit.datasets`).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from torchrl_tit.settings.imports import GROUP, allow, is_named, load_plugins
from torchrl_tit.settings.literals import parse_call

from .recipe import Recipe

TASKS = {
    "": (
        "gymnasium.envs.box2d",
        "gymnasium.envs.classic_control",
        "gymnasium.envs.mujoco",
        "gymnasium.envs.phys2d",
        "gymnasium.envs.tabular",
        "gymnasium.envs.toy_text",
    ),
    "ALE/": ("ale_py",),
    "BabyAI-": ("minigrid",),
    "MinAtar/": ("torchrl_tit.tasks",),
    "MiniGrid-": ("minigrid",),
    "TMaze-": ("torchrl_tit.tasks",),
    "popgym-": ("popgym",),
}
"""The modules of tasks that a file may name, by the beginning of the names that they register."""

_GYMNASIUM = """
    AtariPreprocessing ClipAction ClipReward DelayObservation DiscretizeAction
    DiscretizeObservation DtypeObservation FilterObservation FlattenObservation
    FrameStackObservation GrayscaleObservation MaxAndSkipObservation ObstructView RepeatAction
    RescaleAction RescaleObservation ReshapeObservation ResizeObservation StickyAction
    TimeAwareObservation TimeLimit
"""
_MINIGRID = """
    ActionBonus DictObservationSpaceWrapper DirectionObsWrapper FlatObsWrapper FullyObsWrapper
    ImgObsWrapper NoDeath OneHotPartialObsWrapper PositionBonus RGBImgObsWrapper
    RGBImgPartialObsWrapper ReseedWrapper StochasticActionWrapper SymbolicObsWrapper ViewSizeWrapper
"""
_TORCHRL = """
    ActionDiscretizer ActionScaling BinarizeReward CatTensors CenterCrop ClipTransform Crop
    DTypeCastTransform DoubleToFloat GrayScale LineariseRewards NoopResetEnv ObservationNorm
    PermuteTransform RenameTransform Resize RewardClipping RewardScaling
    SelectTransform SignTransform SqueezeTransform StepCounter TimeMaxPool ToTensorImage
    UnsqueezeTransform
"""
WRAPPERS = {
    "gymnasium.wrappers": frozenset(_GYMNASIUM.split()),
    "minigrid.wrappers": frozenset(_MINIGRID.split()),
    "torchrl.envs": frozenset(_TORCHRL.split()),
    "torchrl.envs.transforms": frozenset(_TORCHRL.split()),
    "torchrl_tit.tasks": frozenset({"FirstActions", "PreviousStep"}),
    "torchrl_tit.transforms": frozenset({"HideEntries"}),
}
"""The wrappers and transforms that a file may name, by their module."""

_PLAIN = re.compile(r"[\w -]*")
_NAMES_A_MODULE = re.compile(r"\s*([^\W\d]\w*(?:\.\w+)*):.*", re.DOTALL)
_OURS = {module.partition(".")[0] for modules in TASKS.values() for module in modules}


def check_names(recipe: Recipe, source: object) -> None:
    """Raises ValueError if a recipe from a file names what a file may not name.

    Nothing that it names is imported.

    Args:
        recipe: the recipe.
        source: the file, for the message.

    Example:
        >>> from dataclasses import replace
        >>> from recipes.core.registry import get_recipe
        >>> recipe = get_recipe("ppo/cartpole/mlp")
        >>> check_names(recipe, "recipe.json")
        >>> check_names(replace(recipe, env="tasks:Mine-v0"), "recipe.json")
        Traceback (most recent call last):
        ...
        ValueError: recipe.json names 'tasks:Mine-v0', which ...: to allow it, add `--import tasks`
    """
    for name, module in _not_listed(recipe):
        raise ValueError(
            f"{source} names {name!r}, which is not on the list of what a file may name, and may "
            f"run programs, write files or download: to allow it, add `--import {module}`"
        )


def allow_names(recipe: Recipe) -> None:
    """Allows what a recipe names that the user typed, or wrote in Python.

    Later commands on its run then say what to type, and processes that this one starts may name
    the same.
    """
    for _, module in list(_not_listed(recipe)):
        if all(part.isidentifier() for part in module.split(".")):  # others cannot be imported
            allow(module)


def may_name_task(name: object) -> bool:
    """Returns whether a file may name a task that Gymnasium has registered.

    Example:
        >>> may_name_task("CartPole-v1"), may_name_task("tasks:Mine-v0"), may_name_task(None)
        (True, False, False)
    """
    return isinstance(name, str) and name in _registry() and not list(_of_task(name, {}))


def _not_listed(recipe: Recipe) -> Iterator[tuple[str, str]]:
    """What a recipe names beyond the list, each with the module that users must allow for it."""
    yield from _of_task(recipe.env, recipe.task_settings)
    for wrapper in recipe.wrappers:
        target, arguments = parse_call(wrapper)
        module, _, name = target.partition(":")
        if name not in WRAPPERS.get(module, ()) and not _is_allowed(module):
            yield target, module
        yield from _of_values(arguments, module)
    address = getattr(recipe, "ray", None)  # a cluster runs what it is sent, and sends objects
    if address is not None and not _is_allowed("ray"):
        yield address, "ray"


def _of_task(env: str, settings: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    module, colon, _ = env.rpartition(":")
    listed = False
    if not colon:
        beginning = max((start for start in TASKS if env.startswith(start)), key=len)
        module = _home(env) or TASKS[beginning][0]
        listed = any(_is_in(module, known) for known in TASKS[beginning])
        # What this program has registered itself, with classes that it has loaded.
        listed |= module in sys.modules and module.partition(".")[0] not in _OURS
    if not listed and not _is_allowed(module):
        yield env, module
    yield from _of_values(settings, module)


def _home(name: str) -> str | None:
    """The module of the class that Gymnasium makes for a name; None if it knows no such name."""
    if name not in _registry() and not any(map(name.startswith, filter(None, TASKS))):
        load_plugins()  # as whoever makes the task would
    # Without a version, Gymnasium makes the newest.
    fitting = [
        spec for known, spec in _registry().items() if name in (known, known.rpartition("-v")[0])
    ]
    if not fitting:
        return None
    made_by = max(fitting, key=lambda spec: spec.version or 0).entry_point
    module = made_by.partition(":")[0] if isinstance(made_by, str) else made_by.__module__
    return str(module)


def _registry() -> Mapping[str, Any]:
    # By name, because commands that read no file start without Gymnasium.
    return import_module("gymnasium").registry


def _of_values(value: Any, module: str) -> Iterator[tuple[str, str]]:
    """What a setting names: another module, or a file or an address for the module that gets it."""
    if isinstance(value, Mapping):
        yield from _of_values([*value, *value.values()], module)
    elif isinstance(value, list | tuple | set):
        for entry in value:
            yield from _of_values(entry, module)
    elif isinstance(value, str) and (named := _NAMES_A_MODULE.fullmatch(value)):
        if not _is_allowed(named[1]):
            yield value, named[1]
    elif not _is_plain(value) and not _is_allowed(module):
        yield str(value), module


def _is_plain(value: Any) -> bool:
    """Whether a literal is a number, None or text that is no path and no address."""
    return bool(_PLAIN.fullmatch(value)) if isinstance(value, str) else not isinstance(value, bytes)


def _is_allowed(module: str) -> bool:
    """Whether the user named a module, or installed it as a plugin."""
    package = module.partition(".")[0]
    return is_named(module) or any(
        point.module.partition(".")[0] == package for point in entry_points(group=GROUP)
    )


def _is_in(module: str, package: str) -> bool:
    return f"{module}.".startswith(f"{package}.")
