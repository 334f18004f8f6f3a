"""The base class of part settings: a registered name, and the module that they build."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from torchrl_tit.settings.fields import check_fields
from torchrl_tit.settings.names import Names


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


def resolve(target: str) -> Any:
    """Imports the object that "module:attribute" names.

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
