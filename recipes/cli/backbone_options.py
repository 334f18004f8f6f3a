"""The options that choose a network by names: ``--backbone.frame``, ``.history`` and ``.network``.

They are read before all others, because the other options include the fields of the chosen parts.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import fields, replace
from itertools import pairwise
from typing import Annotated, Any, TypeVar

import tyro

from torchrl_tit.settings import NETWORKS, FrameSettings, HistorySettings, Part
from torchrl_tit.settings.checks import nearest

from ..recipe import Recipe, field_types

RecipeT = TypeVar("RecipeT", bound=Recipe)
T = TypeVar("T")

_OPTIONS: dict[str, Iterable[str]] = {
    "backbone.network": NETWORKS,
    "backbone.frame": FrameSettings.registered,
    "backbone.history": HistorySettings.registered,
}
"""The options and the names that each takes."""


def choose_network(recipe: RecipeT, arguments: list[str]) -> RecipeT:
    """Returns the recipe with the network that the arguments name.

    ``--backbone.network`` replaces the network by one of the paper's, with as many frames as
    before. ``--backbone.frame`` and ``--backbone.history`` then replace an encoder. A new encoder
    inherits the old one's non-default values in fields that both have; its other fields have their
    defaults.

    The result is not checked: arguments that are read later may be needed for it to be valid, such
    as ``--backbone.num-frames``.

    Args:
        recipe: the recipe.
        arguments: all arguments of the command; unrelated ones are ignored.

    Raises:
        ValueError: if a name is missing or unknown; the message suggests the nearest ones.

    Example:
        >>> from recipes.registry import get_recipe
        >>> arguments = ["--backbone.frame", "resnet", "--backbone.history", "outer"]
        >>> recipe = choose_network(get_recipe("ppo/pong/enhanced-tit"), arguments)
        >>> recipe.backbone.frame
        ResNetFrames(embed_dim=64)
        >>> recipe.backbone.history.name
        'outer'
    """
    names = _read(arguments)
    network = recipe.backbone
    if "backbone.network" in names:
        system = NETWORKS[names["backbone.network"]]()
        network = _replace_unchecked(system, num_frames=network.num_frames)
    if "backbone.frame" in names:
        frame = FrameSettings.get(names["backbone.frame"])
        network = _replace_unchecked(network, frame=_replace_part(network.frame, frame))
    if "backbone.history" in names:
        history = HistorySettings.get(names["backbone.history"])
        network = _replace_unchecked(network, history=_replace_part(network.history, history))
    return _replace_unchecked(recipe, backbone=network)


def check_recipe(recipe: RecipeT) -> RecipeT:
    """Returns the recipe after all checks of its fields, which :func:`choose_network` leaves out.

    Raises:
        ValueError: if a field has an invalid value.
    """
    backbone = recipe.backbone
    frame, history = replace(backbone.frame), replace(backbone.history)
    return replace(recipe, backbone=replace(backbone, frame=frame, history=history))


def option_fields(recipe: Recipe) -> list[tuple[str, Any, str]]:
    """Returns the options as :func:`~dataclasses.make_dataclass` takes them, for tyro and its help.

    Their values are those of the recipe; :func:`choose_network` has read them already.
    """
    help_texts = {
        "backbone.network": "A network of the paper by name, with the recipe's number of frames.",
        "backbone.frame": "Frame encoder; its fields are --backbone.frame.FIELD.",
        "backbone.history": "History encoder; its fields are --backbone.history.FIELD.",
    }
    defaults = {
        "backbone.network": "",
        "backbone.frame": recipe.backbone.frame.name,
        "backbone.history": recipe.backbone.history.name,
    }
    return [
        (
            option.replace(".", "_"),
            Annotated[
                str,
                tyro.conf.arg(
                    name=option,
                    help=help_texts[option],
                    metavar="{" + ",".join(choices) + "}",
                    help_behavior_hint=None if defaults[option] else "",
                ),
            ],
            defaults[option],
        )
        for option, choices in _OPTIONS.items()
    ]


def _read(arguments: list[str]) -> dict[str, str]:
    """Reads the options, as ``--option NAME`` or ``--option=NAME``; the last of several counts."""
    names = {}
    for argument, after in pairwise([*arguments, ""]):
        option, equals, name = argument.removeprefix("--").partition("=")
        if not argument.startswith("--") or option not in _OPTIONS:
            continue
        name = name if equals else after
        choices = _OPTIONS[option]
        if not name or name.startswith("-"):
            raise ValueError(f"--{option} needs a name: {nearest('', choices)}")
        if name not in choices:
            raise ValueError(f"--{option} has no choice {name!r}: {nearest(name, choices)}")
        names[option] = name
    return names


def _replace_part(old: Part, new: type[Any]) -> Any:
    """Builds the settings of another part, with the fields that were chosen for the old one."""
    if type(old) is new:
        return old
    old_types, new_types = field_types(type(old)), field_types(new)
    chosen = {
        field.name: getattr(old, field.name)
        for field in fields(old)
        if getattr(old, field.name) != field.default
    }
    return new(**{n: v for n, v in chosen.items() if new_types.get(n) == old_types[n]})


def _replace_unchecked(settings: T, **values: Any) -> T:
    """Returns a copy of frozen settings with other values, which ``__post_init__`` does not see."""
    copied = copy.copy(settings)
    for name, value in values.items():
        object.__setattr__(copied, name, value)
    return copied
