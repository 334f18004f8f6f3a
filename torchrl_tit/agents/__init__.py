"""Trained agents: a policy with its weights, its task and its evaluation.

An agent is a folder of six files (:mod:`~torchrl_tit.agents.folder`): in this package, anywhere on
the disk, or in a repository of the Hugging Face Hub. Reading one executes nothing.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "AgentError": "folder",
    "TrainedAgent": "loading",
    "agent_names": "loading",
    "load_agent": "loading",
}
"""The module of each public name: who only reads an evaluation need not import what plays."""

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
