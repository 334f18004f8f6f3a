"""Installed packages that add parts, algorithms, tasks or recipes of their own."""

from __future__ import annotations

from importlib.metadata import entry_points

from torchrl_tit.settings.imports import allowed_modules, import_allowed, import_module

GROUP = "torchrl_tit.plugins"
"""The group of entry points: each names a module, whose import registers what it defines."""

_failures: dict[str, str] | None = None


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
