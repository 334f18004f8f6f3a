"""Whether torch.compile works and pays on this machine."""

from __future__ import annotations

import os
import shutil
from functools import cache
from typing import Any, Literal

import torch

Compile = Literal["auto", "on", "off"]

STATIC_SHAPES: dict[str, Any] = {"dynamic": False}
"""How torch.compile is called: which kernels run must not depend on the sizes seen before, or a
resumed run would differ in the last bit."""

# About a minute of compiling is earned back by gradient steps that each save a few milliseconds.
_PAYS_FROM = 10_000
_COMPILERS = (os.environ.get("CXX", "c++"), "g++", "clang++", "cl")


def should_compile(setting: Compile, gradient_steps: int) -> bool:
    """Decides whether an update runs through ``torch.compile``.

    Args:
        setting: "on" and "off" are obeyed; "auto" is on for runs long enough to earn the minute
            that compiling takes, where it works.
        gradient_steps: how many the whole run has.

    Raises:
        ValueError: if it is "on" and there is no C++ compiler.

    Example:
        >>> should_compile("auto", gradient_steps=100)
        False
    """
    if setting == "on" and not _has_compiler():
        raise ValueError(
            f"compile is on, but there is no C++ compiler (looked for {', '.join(_COMPILERS)}): "
            "install one, or set compile to off"
        )
    if setting == "auto":
        return gradient_steps >= _PAYS_FROM and _has_compiler() and _works()
    return setting == "on"


def _has_compiler() -> bool:
    return any(map(shutil.which, _COMPILERS))


@cache
def _works() -> bool:
    """Compiles something small: a compiler can be there and still lack headers or OpenMP."""
    try:
        torch.compile(lambda x: x.sin() + 1)(torch.ones(8))
    except Exception:  # whatever the toolchain says, "auto" goes on without it
        return False
    return True
