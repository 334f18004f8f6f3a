"""Tables of things that users choose by name; other packages can add to them."""

from __future__ import annotations

from typing import TypeVar

from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.plugins import load_plugins

T = TypeVar("T")


class Names(dict[str, T]):
    """Things by name. Each name belongs to one thing; unknown names are looked up in plugins.

    Args:
        kind: what the things are, for error messages.

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
        """Adds a thing. It replaces an earlier one with the same name and home.

        Args:
            name: its name.
            thing: the thing.
            home: where it is defined, for error messages.

        Raises:
            ValueError: if the name already belongs to a thing from elsewhere.
        """
        if self._homes.setdefault(name, home) != home:
            self._clashes[name] = (
                f"two {self.kind}s are called {name!r}, in {self._homes[name]} and in {home}: "
                "rename one of them"
            )
            raise ValueError(self._clashes[name])
        self[name] = thing

    def find(self, name: str) -> T:
        """Looks up a name, also in plugins if it is unknown.

        Raises:
            ValueError: if no thing, or more than one, has that name. The message suggests similar
                names, and says which plugins could not be imported.
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
