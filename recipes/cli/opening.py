"""Opening run folders that commands are given, which may come from strangers."""

from __future__ import annotations

from pathlib import Path

from ..agents.named_parts import check_named_parts
from ..run import Run


def open_run(folder: Path) -> Run:
    """Opens a run that will act; as for agents, the parts that its recipe names may only compute.

    Raises:
        AgentError: if its recipe names a task or a wrapper that may do more than compute, and that
            the user did not name.
        FileNotFoundError: if the folder is not a run folder.
        ValueError: if its recipe cannot be read, or a part that it names does not exist.
    """
    run = Run.open(folder)
    check_named_parts(run.recipe)
    return run
