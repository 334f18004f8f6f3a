"""The options that choose a network by name: ``--backbone.frame``, ``.history`` and ``.network``.

``--backbone.frames.KEY`` chooses the frame encoder of one of several observations.

These options are parsed before all others, because the other options include the fields of the
chosen parts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, TypeVar

from torchrl_tit.settings import NETWORKS, FrameSettings, HistorySettings, Part
from torchrl_tit.settings.checks import field_types, nearest
from torchrl_tit.settings.imports import load_plugins

from ..core.recipe import Recipe

RecipeT = TypeVar("RecipeT", bound=Recipe)
T = TypeVar("T")

_OPTIONS: dict[str, Iterable[str]] = {
    "backbone.network": NETWORKS,
    "backbone.frame": FrameSettings.registered,
    "backbone.history": HistorySettings.registered,
}
"""The options and the names that each takes."""

_PER_KEY = "backbone.frames."
"""Prefix of the options for one observation, whose name follows."""


def choose_network(recipe: RecipeT, arguments: list[str]) -> tuple[RecipeT, list[str]]:
    """Returns the recipe with the network that the arguments name, and the other arguments.

    ``--backbone.network`` replaces the network by one of the paper's, with as many frames as
    before. ``--backbone.frame`` and ``--backbone.history`` then replace an encoder. A new encoder
    inherits the old one's non-default values in fields that both have; its other fields have their
    defaults. ``--backbone.frames.KEY`` names the frame encoder of one of several observations,
    which also inherits the width; ``--backbone.frames.KEY.FIELD`` alone starts from the recipe's
    frame encoder.

    The result is not checked, because arguments that are parsed later, such as
    ``--backbone.num-frames``, may be needed to make it valid.

    Args:
        recipe: the recipe.
        arguments: all arguments of the command.

    Raises:
        ValueError: if a name is missing or unknown; the message suggests the nearest ones.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> arguments = ["--backbone.frame", "resnet", "--backbone.history", "outer"]
        >>> recipe, _ = choose_network(get_recipe("ppo/pong/enhanced-tit"), arguments)
        >>> recipe.backbone.frame
        ResNetFrames(embed_dim=64)
        >>> recipe.backbone.history.name
        'outer'
    """
    names, rest = _read(arguments)
    network = recipe.backbone
    if "backbone.network" in names:
        system = NETWORKS[names["backbone.network"]]()
        network = _draft(system, num_frames=network.num_frames)
    if "backbone.frame" in names:
        frame = FrameSettings.get(names["backbone.frame"])
        network = _draft(network, frame=_replace_part(network.frame, frame))
    if "backbone.history" in names:
        history = HistorySettings.get(names["backbone.history"])
        network = _draft(network, history=_replace_part(network.history, history))
    frames = dict(network.frames)
    for key in _keys_with_fields(arguments):
        frames.setdefault(key, network.frame)
    for option, name in names.items():
        if option.startswith(_PER_KEY):
            key = option.removeprefix(_PER_KEY)
            old = frames.get(key, network.frame)
            frames[key] = _with_width_of(old, _replace_part(old, FrameSettings.get(name)))
    network = _draft(network, frames=frames)
    return _draft(recipe, backbone=network), rest


def check_recipe(recipe: RecipeT) -> RecipeT:
    """Runs all checks of a recipe's fields, which :func:`choose_network` skips, and returns it.

    Raises:
        ValueError: if a field has an invalid value.
    """
    backbone = recipe.backbone
    frame, history = replace(backbone.frame), replace(backbone.history)
    frames = {key: replace(part) for key, part in backbone.frames.items()}
    backbone = replace(backbone, frame=frame, frames=frames, history=history)
    return replace(recipe, backbone=backbone)


def describe_options(recipe: Recipe) -> str:
    """Describes the options for the help, with the recipe's encoders."""
    words = {
        "backbone.network": "a network by its name, with the recipe's number of frames",
        "backbone.frame": f"the frame encoder, here {recipe.backbone.frame.name}; "
        "--backbone.frames.KEY is that of one of several observations",
        "backbone.history": f"the history encoder, here {recipe.backbone.history.name}",
    }
    return "\n".join(
        f"--{option} {{{','.join(_choices(option))}}}: {text}." for option, text in words.items()
    )


def _choices(option: str) -> Iterable[str]:
    """The names that an option accepts; empty if there is no such option."""
    if option.startswith(_PER_KEY) and "." not in option.removeprefix(_PER_KEY):
        return FrameSettings.registered
    return _OPTIONS.get(option, ())


def _read(arguments: list[str]) -> tuple[dict[str, str], list[str]]:
    """Reads the options, ``--option NAME`` or ``--option=NAME``, of which the last one counts.

    Example:
        >>> _read(["--backbone.frame", "inner", "--backbone.history=outer", "--seed", "3"])
        ({'backbone.frame': 'inner', 'backbone.history': 'outer'}, ['--seed', '3'])
    """
    names, rest, words = {}, [], iter(arguments)
    for word in words:
        option, equals, name = word.removeprefix("--").partition("=")
        choices = _choices(option)
        if not word.startswith("--") or not choices:
            rest.append(word)
            continue
        name = name if equals else next(words, "")
        if not name or name.startswith("-"):
            raise ValueError(f"--{option} needs a name: {nearest('', choices)}")
        failures = load_plugins() if name not in choices else []
        if name not in choices:
            reason = (
                f"--{option} has no choice {name!r}: {nearest(name, choices)} (one of your own "
                "needs `--import MODULE`)"
            )
            raise ValueError("; ".join([reason, *failures]))
        names[option] = name
    return names, rest


def _keys_with_fields(arguments: list[str]) -> list[str]:
    """The observations that have an option ``--backbone.frames.KEY.FIELD``."""
    options = (a.removeprefix(f"--{_PER_KEY}") for a in arguments if a.startswith(f"--{_PER_KEY}"))
    keys = (option.partition("=")[0].rpartition(".")[0] for option in options)
    return [key for key in keys if key]


def _replace_part(old: Part, new: type[Any]) -> Any:
    """Builds settings of a new part, with the old part's non-default values in common fields."""
    if type(old) is new:
        return old
    old_types, new_types = field_types(type(old)), field_types(new)
    chosen = {
        field.name: getattr(old, field.name)
        for field in fields(old)
        if getattr(old, field.name) != field.default
    }
    return new(**{n: v for n, v in chosen.items() if new_types.get(n) == old_types[n]})


def _with_width_of(old: Part, new: Any) -> Any:
    """Returns settings with the old ones' width: tokens of all observations have the same width."""
    if "embed_dim" in field_types(type(old)) and "embed_dim" in field_types(type(new)):
        return _draft(new, embed_dim=getattr(old, "embed_dim"))  # noqa: B009
    return new


def _draft(settings: T, **values: Any) -> T:
    """Makes settings like these with other values, but runs none of the checks yet."""
    draft = object.__new__(type(settings))
    vars(draft).update(vars(settings) | values)
    return draft
