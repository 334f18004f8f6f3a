"""Imports by name, and the modules that users named in their own words."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

# An environment variable, so that child processes may import the same modules.
_VARIABLE = "TORCHRL_TIT_IMPORTS"


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


def import_named(target: str) -> Any:
    """Imports the object that "module:attribute" names.

    Raises:
        ValueError: if the target has another form.
        ImportError: if the module does not exist, raises an error, or lacks the attribute.

    Example:
        >>> import_named("math:pi")
        3.141592653589793
    """
    module, colon, attribute = target.partition(":")
    if not (module and colon and attribute.isidentifier()):
        raise ValueError(f"{target!r} names nothing to import: expected module:attribute")
    try:
        return getattr(import_module(module), attribute)
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
