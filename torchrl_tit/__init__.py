"""Transformer in Transformer (TIT) backbones for deep RL, as TorchRL components.

Every network here is a frame encoder followed by a history encoder; everything else is TorchRL.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import Any

_HOMES = {
    "Backbone": "torchrl_tit.modules",
    "EnhancedTIT": "torchrl_tit.networks",
    "History": "torchrl_tit.transforms",
    "HistoryNetwork": "torchrl_tit.networks",
    "Inner": "torchrl_tit.settings",
    "Outer": "torchrl_tit.settings",
    "PairedOuter": "torchrl_tit.settings",
    "VanillaTIT": "torchrl_tit.networks",
    "load_agent": "torchrl_tit.agents",
}
"""The module of each public name. PyTorch is imported when a name that needs it is first used."""

__all__ = [*_HOMES]


def _version() -> str:
    try:
        return importlib.metadata.version("torchrl-tit")
    except importlib.metadata.PackageNotFoundError:  # a clone that is not installed
        return "not installed"


__version__ = _version()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
