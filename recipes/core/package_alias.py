"""One set of modules, whichever of its two names the package is imported by.

In a clone, the package is called ``recipes``; installed, it is ``torchrl_tit.recipes``, the name
that users' packages import. An editable install has both. If modules were loaded twice, the command
line would not see what such a package registers. Python loads a module once for each name that it
is imported by, whatever folders and entries of ``sys.modules`` say about its package, so two names
for one set of submodules need a finder.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class SameModules(MetaPathFinder, Loader):
    """Finds the modules of a package under another name of that package.

    Args:
        name: the name that the package is loaded by.
        other: its other name.
    """

    def __init__(self, name: str, other: str) -> None:
        self.name = name
        self.other = other

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Finds modules below the other name."""
        if not f"{fullname}.".startswith(f"{self.other}."):
            return None
        found = importlib.util.find_spec(self._own(fullname))
        return None if found is None else ModuleSpec(fullname, self, loader_state=found)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Imports the module by its own name."""
        return importlib.import_module(self._own(spec.name))

    def exec_module(self, module: ModuleType) -> None:
        """Restores the specification of the module, which is already loaded."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state

    def _own(self, fullname: str) -> str:
        return self.name + fullname.removeprefix(self.other)


def share_modules(name: str) -> None:
    """Makes ``recipes`` and ``torchrl_tit.recipes`` one package; called while it is imported.

    An unrelated package that is called ``recipes`` is left alone.

    Args:
        name: the name that the package is being imported by.
    """
    if name != "recipes":
        return
    installed = sys.modules.get("torchrl_tit.recipes")
    if installed is None:
        sys.meta_path.insert(0, SameModules("recipes", "torchrl_tit.recipes"))
    elif os.path.samefile(str(installed.__file__), str(sys.modules["recipes"].__file__)):
        sys.meta_path.insert(0, SameModules("torchrl_tit.recipes", "recipes"))
        sys.modules["recipes"] = installed
