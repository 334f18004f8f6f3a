"""The tasks and wrappers that an agent's recipe may name: those that only compute.

Agents can come from strangers. Any recipe may name modules of gymnasium and torchrl, but some of
their classes import other modules, start programs, write files or download: GymEnv,
UnityMLAgentsEnv, RecordVideo, R3MTransform. To use these, users must name their module.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.agents import AgentError
from torchrl_tit.envs.names import find_task
from torchrl_tit.settings.imports import TRUSTED, import_named, is_named
from torchrl_tit.settings.literals import parse_call

from ..recipe import Recipe

_COMPUTING = frozenset(
    {
        # gymnasium.wrappers
        "AtariPreprocessing",
        "ClipAction",
        "ClipReward",
        "DelayObservation",
        "DiscretizeAction",
        "DiscretizeObservation",
        "DtypeObservation",
        "FilterObservation",
        "FlattenObservation",
        "FrameStackObservation",
        "GrayscaleObservation",
        "MaxAndSkipObservation",
        "NormalizeObservation",
        "NormalizeReward",
        "ObstructView",
        "RepeatAction",
        "RescaleAction",
        "RescaleObservation",
        "ReshapeObservation",
        "ResizeObservation",
        "StickyAction",
        "TimeAwareObservation",
        "TimeLimit",
        # torchrl.envs
        "ActionDiscretizer",
        "ActionScaling",
        "BinarizeReward",
        "CatTensors",
        "CenterCrop",
        "ClipTransform",
        "Crop",
        "DTypeCastTransform",
        "DoubleToFloat",
        "FrameSkipTransform",
        "GrayScale",
        "LineariseRewards",
        "NoopResetEnv",
        "ObservationNorm",
        "PendulumEnv",
        "PermuteTransform",
        "RenameTransform",
        "Resize",
        "RewardClipping",
        "RewardScaling",
        "SelectTransform",
        "SignTransform",
        "SqueezeTransform",
        "StepCounter",
        "TimeMaxPool",
        "ToTensorImage",
        "UnsqueezeTransform",
        "VecNorm",
        "VecNormV2",
    }
)
_LIBRARIES = ("gymnasium", "torchrl")


def check_named_parts(recipe: Recipe) -> None:
    """Raises AgentError if a recipe names a task or a wrapper that may do more than compute.

    Those in a module that the user named are allowed.

    Raises:
        AgentError: if it does.
        ValueError: if there is no such task or wrapper, or its module may not be imported.

    Example:
        >>> from dataclasses import replace
        >>> from recipes.registry import get_recipe
        >>> recipe = get_recipe("ppo/cartpole/mlp")
        >>> check_named_parts(recipe)
        >>> check_named_parts(replace(recipe, wrappers=("gymnasium.wrappers:RecordVideo",)))
        Traceback (most recent call last):
        ...
        torchrl_tit.agents.folder.AgentError: 'gymnasium.wrappers:RecordVideo' may start programs...
    """
    if ":" in recipe.env:
        _check(recipe.env, find_task(recipe.env))
    for wrapper in recipe.wrappers:
        target, _ = parse_call(wrapper)
        try:
            found = import_named(target)
        except ImportError as error:
            raise ValueError(f"Wrapper {wrapper!r} cannot be used: {error}.") from error
        _check(target, found)


def _check(target: str, found: Any) -> None:
    """Checks what a name stands for; a string is a name that Gymnasium has registered."""
    module = target.partition(":")[0]
    if isinstance(found, str) or is_named(module):
        return
    # Where it is defined, not where it was named: modules import from each other.
    home = str(getattr(found, "__module__", "")).partition(".")[0]
    if isinstance(found, type):
        safe = home not in _LIBRARIES or found.__name__ in _COMPUTING
    else:  # such as a function that takes names of further tasks
        safe = home not in TRUSTED
    if not safe:
        raise AgentError(
            f"{target!r} may start programs, write files or download, which the recipe of a run or "
            f"an agent may not ask for: to allow it, add `--import {module}`"
        )
