"""Whether torch.compile works on this machine, and whether it is worth the time."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable
from copy import deepcopy
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch

from .algorithm import Algorithm
from .optional import tqdm
from .recipe import Compile

P = ParamSpec("P")
T = TypeVar("T")

STATIC_SHAPES: dict[str, Any] = {"dynamic": False, "isolate_recompiles": True}
"""Arguments of torch.compile: the choice of kernels must not depend on the sizes seen before, or a
resumed run would differ in the last bit. Nor on other runs in the same process: by default, all
that is compiled from one function shares its graphs, and the number of them is limited."""
ONLY_TENSORS: dict[str, Any] = {
    **STATIC_SHAPES,
    "fullgraph": True,
    "options": {"guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe},
}
"""The same for functions where only tensors change between calls. Guards on everything else would
take as long as several small layers, at every call. Where a graph breaks, code without guards would
take one module for another, so it must be one graph; and a run that shared it with another would
take its numbers (heads, activations, weights of losses) for its own."""

# Compiling takes about a minute, and each gradient step then saves a few milliseconds.
_PAYS_FROM = 10_000
# In modules of these packages, only tensors change between calls.
_KNOWN = {__name__.partition(".")[0], "torchrl_tit", "torchrl", "tensordict", "torch"}
_COMPILERS = (os.environ.get("CXX", "c++"), "g++", "clang++", "cl")


def should_compile(setting: Compile, gradient_steps: int) -> bool:
    """Decides whether an update runs through ``torch.compile``.

    Args:
        setting: "on" and "off" are final; "auto" compiles, if that works, in runs long enough to
            make up for the minute it takes.
        gradient_steps: number of gradient steps in the whole run.

    Raises:
        ValueError: if it is "on" and there is no C++ compiler.

    Example:
        >>> should_compile("auto", gradient_steps=100)
        False
    """
    check_compiler(setting)
    if setting == "auto":
        return gradient_steps >= _PAYS_FROM and _has_compiler() and _works()
    return setting == "on"


def check_compiler(setting: Compile) -> None:
    """Checks that compilation is possible if it is required, without compiling anything yet.

    Raises:
        ValueError: if the setting is "on" and there is no C++ compiler.

    Example:
        >>> check_compiler("auto")
    """
    if setting == "on" and not _has_compiler():
        raise ValueError(
            f"compile is on, but there is no C++ compiler (looked for {', '.join(_COMPILERS)}): "
            "install one, or set compile to off"
        )


def compile_and_time(function: Callable[P, T], name: str, owner: Algorithm[Any]) -> Callable[P, T]:
    """Compiles a function, and prints how long its first call took, which includes compilation.

    Between calls, only tensors change in the algorithms and modules of this package and of those it
    builds on, and no mode and no number. A user's may change numbers, which code without guards
    would keep as they were in the first call, or do what has no graph, such as printing.

    Args:
        function: the function.
        name: what it is, for the message.
        owner: the algorithm that calls it.
    """
    parts = (owner, *owner.model.modules(), *owner.policy.modules())
    ours = all(type(part).__module__.partition(".")[0] in _KNOWN for part in parts)
    # torch.compile takes the filter out of the options that it is given.
    fast = torch.compile(function, **deepcopy(ONLY_TENSORS if ours else STATIC_SHAPES))
    first = True

    @wraps(function)
    def timed(*args: P.args, **kwargs: P.kwargs) -> T:
        nonlocal first
        if not first:
            return fast(*args, **kwargs)
        first = False
        start = time.perf_counter()
        result = fast(*args, **kwargs)
        tqdm.tqdm.write(f"compiled {name} in {time.perf_counter() - start:.0f} s", file=sys.stderr)
        return result

    return timed


def _has_compiler() -> bool:
    return any(map(shutil.which, _COMPILERS))


@cache
def _works() -> bool:
    """Compiles a small function: a compiler can be installed and still lack headers or OpenMP."""
    try:
        torch.compile(lambda x: x.sin() + 1)(torch.ones(8))
    except Exception:  # whatever the toolchain reports, "auto" then does not compile
        return False
    return True
