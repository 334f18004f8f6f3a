"""Exchangeable parts: settings with a registered name, and the module that they build."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeVar

from torchrl_tit.settings.checks import check_fields, nearest
from torchrl_tit.settings.imports import load_plugins, resolve

T = TypeVar("T")


class Names(dict[str, T]):
    """Things by name. Each name belongs to one thing; unknown names are looked up in plugins.

    Args:
        kind: what the things are, for error messages.

    Example:
        >>> colors = Names("color")
        >>> colors.add("red", 0xFF0000, "paint")
        >>> colors.find("red")
        16711680
        >>> colors.add("red", 0xEE0000, "other.paint")
        Traceback (most recent call last):
            ...
        ValueError: two colors are called 'red', in paint and in other.paint: rename one of them
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


@dataclass(frozen=True, kw_only=True)
class Part:
    """Settings of an exchangeable part. A subclass is registered when it is defined.

    A kind of part is a subclass with ``kind``; a part is a subclass of that with ``name``, the name
    that recipes and the command line use, and ``builds``, its implementation as "module:Class",
    which is imported when the part is built.

    Raises:
        ValueError: if two parts of a kind have the same name.

    Example:
        >>> from torchrl_tit.settings import FrameSettings, Inner
        >>> FrameSettings.get("inner") is Inner
        True
        >>> Inner(patch_size=12).name, Inner.builds
        ('inner', 'torchrl_tit.frames.inner:InnerTransformer')
    """

    kind: ClassVar[str]
    name: ClassVar[str]
    builds: ClassVar[str]
    registered: ClassVar[Names[type[Any]]]
    """All parts of the kind by name."""

    def __init_subclass__(
        cls, *, kind: str | None = None, name: str | None = None, builds: str | None = None
    ) -> None:
        super().__init_subclass__()
        if kind is not None:
            cls.kind, cls.registered = kind, Names(kind)
        if name is not None and builds is not None:
            cls.registered.add(name, cls, f"{cls.__module__}.{cls.__qualname__}")
            cls.name, cls.builds = name, builds

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def get(cls, name: str) -> type[Self]:
        """Looks up a part of this kind, in installed plugins too.

        Raises:
            ValueError: if no part, or more than one, has that name; the message suggests similar
                names.
        """
        return cls.registered.find(name)

    @classmethod
    def from_older(cls, fields: dict[str, Any]) -> dict[str, Any]:
        """Renames fields in JSON from older versions of the part; by default, renames none.

        Args:
            fields: the fields by name, which may be changed in place.
        """
        return fields

    def build(self, *args: Any, **kwargs: Any) -> Any:
        """Imports the implementation and builds it: ``Class(settings, *args, **kwargs)``."""
        return resolve(self.builds)(self, *args, **kwargs)
