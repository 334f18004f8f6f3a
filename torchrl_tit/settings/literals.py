"""Parses values and calls that users type: Python literals only, so no code is run."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from typing import Any


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Reads settings such as "is_slippery=False" or "map_name=8x8".

    Args:
        assignments: strings "name=value", with a Python literal as the value; anything else is kept
            as text.

    Returns:
        The values by name.

    Raises:
        ValueError: if an assignment has another form, a name occurs twice, or a value is "true",
            "false" or "none".

    Example:
        >>> parse_assignments(["is_slippery=False", "map_name=8x8", "sizes=(3, 4)"])
        {'is_slippery': False, 'map_name': '8x8', 'sizes': (3, 4)}
    """
    values: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not (equals and name.isidentifier()):
            raise ValueError(f"expected NAME=VALUE, such as is_slippery=False, not {assignment!r}")
        if name in values:
            raise ValueError(f"{name} is set twice, the second time by {assignment!r}")
        try:
            values[name] = ast.literal_eval(text.strip())
        except (SyntaxError, ValueError, MemoryError, RecursionError):  # or nested too deeply
            if (literal := text.strip().capitalize()) in ("True", "False", "None"):
                raise ValueError(f"{assignment!r} would be text: write {name}={literal}") from None
            values[name] = text.strip()
    return values


def parse_call(text: str) -> tuple[str, dict[str, Any]]:
    """Reads "module:Name" or "module:Name(argument=literal, ...)".

    Returns:
        "module:Name", and the arguments.

    Raises:
        ValueError: if it has another form, or an argument is not a literal.

    Example:
        >>> parse_call("minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=8)")
        ('minigrid.wrappers:RGBImgPartialObsWrapper', {'tile_size': 8})
    """
    target, _, rest = text.strip().partition("(")
    module, _, name = target.strip().partition(":")
    if not (name.isidentifier() and all(part.isidentifier() for part in module.split("."))):
        raise ValueError(
            f"{text!r} does not name a class: expected module:Class, or "
            "module:Class(argument=literal, ...)"
        )
    if not rest:
        return f"{module}:{name}", {}
    try:
        call = ast.parse(f"f({rest}", mode="eval").body
    except (SyntaxError, MemoryError, RecursionError):
        call = None
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
        raise ValueError(f"the arguments in {text!r} are not closed, or not those of one call")
    return f"{module}:{name}", {key: value for key, value in _arguments(call, text)}


def _arguments(call: ast.Call, text: str) -> Iterable[tuple[str, Any]]:
    if call.args or any(keyword.arg is None for keyword in call.keywords):
        raise ValueError(f"the arguments in {text!r} need their names, as in Class(argument=1)")
    for keyword in call.keywords:
        assert keyword.arg is not None
        try:
            yield keyword.arg, ast.literal_eval(keyword.value)
        except (SyntaxError, ValueError) as error:
            raise ValueError(
                f"{keyword.arg}={ast.unparse(keyword.value)} in {text!r} is no literal, such as "
                "8, 0.5, True, 'text' or (8, 8)"
            ) from error
