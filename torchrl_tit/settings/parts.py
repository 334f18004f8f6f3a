"""The base class of part settings: a registered name, and the module that they build."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from torchrl_tit.settings.checks import nearest


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
    registered: ClassVar[dict[str, type[Any]]]
    """All parts of the kind by name."""

    def __init_subclass__(
        cls, *, kind: str | None = None, name: str | None = None, builds: str | None = None
    ) -> None:
        super().__init_subclass__()
        if kind is not None:
            cls.kind, cls.registered = kind, {}
        if name is not None and builds is not None:
            other = cls.registered.get(name)
            if other is not None and (other.__module__, other.__qualname__) != (
                cls.__module__,
                cls.__qualname__,
            ):
                raise ValueError(
                    f"two {cls.kind}s are called {name!r}: {other.__module__}.{other.__qualname__} "
                    f"and {cls.__module__}.{cls.__qualname__}; rename one of them"
                )
            cls.name, cls.builds = name, builds
            cls.registered[name] = cls

    @classmethod
    def get(cls, name: str) -> type[Self]:
        """Looks up a part of this kind.

        Raises:
            ValueError: if no part has that name; the message suggests similar names.
        """
        if name not in cls.registered:
            raise ValueError(f"unknown {cls.kind} {name!r}: {nearest(str(name), cls.registered)}")
        return cls.registered[name]

    def build(self, *args: Any, **kwargs: Any) -> Any:
        """Imports the implementation and builds it: ``Class(settings, *args, **kwargs)``."""
        return resolve(self.builds)(self, *args, **kwargs)


def resolve(target: str) -> Any:
    """Imports what "module:attribute" names.

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
