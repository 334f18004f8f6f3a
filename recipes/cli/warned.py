"""Warnings on the command line: a line each, and each once."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torchrl_tit

_OURS = (str(Path(torchrl_tit.__file__).parent), str(Path(__file__).parents[1]))


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Writes warnings as "warning: TEXT", without the source that Python shows.

    Those of other libraries are followed by their place. Python repeats a warning whenever the
    filters have changed since, as TorchRL and Gymnasium do; here its text stands once.
    """
    shown: set[str] = set()

    def write(
        message: Warning | str, category: type, filename: str, lineno: int, line: str | None = None
    ) -> str:
        text = f"warning: {' '.join(str(message).split())}"
        if not filename.startswith(_OURS):
            text += f" ({filename}:{lineno})"
        if text in shown:
            return ""
        shown.add(text)
        return f"{text}\n"

    before = warnings.formatwarning
    warnings.formatwarning = write
    try:
        yield
    finally:
        warnings.formatwarning = before
