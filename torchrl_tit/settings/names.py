"""Tables of what users choose by name, to which packages of their own add."""

from __future__ import annotations

from typing import TypeVar

from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.plugins import load_plugins

T = TypeVar("T")


class Names(dict[str, T]):
    """Things by name. A name belongs to one thing, and unknown names are looked for in plugins.

    Args:
        kind: what they are, for messages.

    Example:
        >>> colours = Names("colour")
        >>> colours.add("red", 0xFF0000, "paint")
        >>> colours.find("red")
        16711680
        >>> colours.add("red", 0xEE0000, "other.paint")
        Traceback (most recent call last):
            ...
        ValueError: two colours are called 'red', in paint and in other.paint: rename one of them
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind
        self._homes: dict[str, str] = {}
        self._clashes: dict[str, str] = {}

    def add(self, name: str, thing: T, home: str) -> None:
        """Adds a thing. If it comes from the same place as before, it replaces the one before.

        Args:
            name: its name.
            thing: the thing.
            home: where it is defined, for messages.

        Raises:
            ValueError: if the name belongs to a thing from elsewhere.
        """
        if self._homes.setdefault(name, home) != home:
            self._clashes[name] = (
                f"two {self.kind}s are called {name!r}, in {self._homes[name]} and in {home}: "
                "rename one of them"
            )
            raise ValueError(self._clashes[name])
        self[name] = thing

    def find(self, name: str) -> T:
        """Looks a name up, in plugins too if it is unknown.

        Raises:
            ValueError: if nothing, or more than one thing, has that name. The message suggests
                similar names, and says which plugins could not be imported.
        """
        failures = load_plugins() if str(name) not in self else []
        if str(name) in self._clashes:
            raise ValueError(self._clashes[name])
        if str(name) not in self:
            raise ValueError(
                "; ".join(
                    [
                        f"unknown {self.kind} {name!r}: {nearest(str(name), self)} "
                        "(one of your own needs `--import MODULE`)",
                        *failures,
                    ]
                )
            )
        return self[name]
