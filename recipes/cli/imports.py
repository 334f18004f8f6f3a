"""Users' own modules: ``--import MODULE``, and tasks and wrappers named as MODULE:NAME."""

from __future__ import annotations

import re
from collections.abc import Iterator

from torchrl_tit.settings.imports import allow, import_allowed

OPTION = "--import"
HELP = (
    "module (or Python file) of your own to import first, for what it registers; can be repeated; "
    "an option of every command"
)

_MODULE_AND_NAME = re.compile(r"(?:--[\w.-]+=)?([A-Za-z_][\w.]*):[A-Za-z_][\w/-]*(?:\(.*\))?")


def import_what_is_typed(arguments: list[str]) -> list[str]:
    """Imports the modules of ``--import``, and allows those that other arguments name.

    Args:
        arguments: all arguments of the program.

    Returns:
        The arguments without ``--import``.

    Raises:
        ImportError: if a module cannot be imported.
        ValueError: if the option lacks the module.
    """
    rest, modules = [], []
    words = iter(arguments)
    for word in words:
        option, equals, module = word.partition("=")
        if option == OPTION:
            modules.append(module if equals else next(words, ""))
        else:
            rest.append(word)
    for module in modules:
        if not module or module.startswith("-"):
            raise ValueError(f"{OPTION} needs the name of a module, such as my_package")
        import_allowed(module)
    for module in _named(rest):
        allow(module)
    return rest


def _named(arguments: list[str]) -> Iterator[str]:
    """Modules in arguments such as ``module:Task-v0``: users who type one want it imported."""
    for argument in arguments:
        found = _MODULE_AND_NAME.fullmatch(argument)
        # `hf:user/name` is an agent, whose files are not the user's own word.
        if found and found[1] != "hf" and not found[1].endswith((".", ".py")):
            yield found[1]
