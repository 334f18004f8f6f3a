"""Imports by name: the modules that users named in their own words, and installed plugins.

What a file may name beside them is said in :mod:`recipes.core.trust`.
"""

from __future__ import annotations

import importlib
import os
import sys
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

GROUP = "torchrl_tit.plugins"
"""The group of entry points: each names a module, whose import registers what it defines."""

# An environment variable, so that child processes may import the same modules.
_VARIABLE = "TORCHRL_TIT_IMPORTS"

_failures: dict[str, str] | None = None
"""Why modules of plugins could not be imported; None before they are."""


def allow(module: str) -> None:
    """Allows files to name a module that the user named, and its submodules.

    Adds a folder to ``sys.path``: that of a Python file, otherwise the current directory, as
    ``python -m`` does.

    Args:
        module: a module's name, or the path of a Python file (ending in ".py").

    Raises:
        ValueError: if it is neither.
    """
    name = _module_name(module)
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(
            f"{module!r} is not the name of a module: expected a name such as "
            "my_package.my_module, or the path of a Python file whose name has only letters, "
            "digits and '_'"
        )
    folder = str(Path(module).absolute().parent) if module.endswith(".py") else os.getcwd()
    if folder not in sys.path and not (folder == os.getcwd() and "" in sys.path):
        sys.path.insert(0, folder)
        importlib.invalidate_caches()
    if name not in map(_module_name, allowed_modules()):
        os.environ[_VARIABLE] = os.pathsep.join([*allowed_modules(), module])


def allowed_modules() -> list[str]:
    """Returns the modules that the user named, as typed and in order, for child processes."""
    return list(filter(None, os.environ.get(_VARIABLE, "").split(os.pathsep)))


def is_named(module: str) -> bool:
    """Returns whether the user named a module or a parent package (:func:`allow`)."""
    return any(f"{module}.".startswith(f"{_module_name(name)}.") for name in allowed_modules())


def import_options() -> list[str]:
    """Returns the allowed modules as command-line options, ``--import MODULE`` for each."""
    return [word for module in allowed_modules() for word in ("--import", module)]


def import_allowed(module: str) -> ModuleType:
    """Imports a module or Python file that the user named, and allows it (:func:`allow`).

    Raises:
        ImportError: if the module does not exist or raises an error; the message gives the reason
            in one line.
        ValueError: if it is neither the name of a module nor a Python file, or if another module
            with the file's name is already loaded.
    """
    allow(module)
    if not module.endswith(".py"):
        return import_module(module)
    if not Path(module).is_file():
        raise ImportError(f"there is no file {module}")
    name = _module_name(module)
    loaded = import_module(name)
    origin = getattr(loaded, "__file__", None)
    if origin is None or not os.path.samefile(origin, module):
        raise ValueError(f"{module} has the name of another module, {name} ({origin}): rename it")
    return loaded


def resolve(target: str) -> Any:
    """Imports the object that "module:attribute" names, of code that is trusted.

    Raises:
        ImportError: if there is no such module, or it lacks the attribute.

    Example:
        >>> resolve("math:pi")
        3.141592653589793
    """
    module, _, attribute = target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except AttributeError as error:
        raise ImportError(
            f"module {module} has no {attribute!r}, which {target!r} names"
        ) from error


def import_module(name: str) -> ModuleType:
    """Imports a module.

    Raises:
        ImportError: if the module does not exist or raises an error; the message gives the reason
            in one line.
    """
    try:
        return importlib.import_module(name)
    except Exception as error:  # a user's module can raise anything
        raise ImportError(_reason(name, error)) from error


def load_plugins() -> list[str]:
    """Imports the modules that installed packages and the user have named, once.

    It is called only for names that are otherwise unknown, so that other commands neither wait for
    a plugin nor fail because of it.

    Returns:
        For each module that cannot be imported, a line that names its package and entry point.
    """
    global _failures
    if _failures is None:
        _failures = {}  # before the imports, which may look up names themselves
        for module in allowed_modules():  # of the process that started this one
            import_allowed(module)
        for point in entry_points(group=GROUP):
            try:
                import_module(point.module)
            except ImportError as error:
                package = point.dist.name if point.dist else "an unknown package"
                _failures[point.value] = (
                    f"the entry point {point.name!r} of the package {package} failed: {error}"
                )
    return list(_failures.values())


def _reason(name: str, error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
        return (
            f"there is no module {error.name!r}, looked for in the current directory and in the "
            "installed packages"
        )
    if isinstance(error, SyntaxError):
        return f"{error.filename or name} is not Python: {error.msg} (line {error.lineno})"
    return f"module {name!r} cannot be imported: {type(error).__name__}: {error}"


def _module_name(module: str) -> str:
    """The name under which a module or a file is imported."""
    return Path(module).stem if module.endswith(".py") else module
