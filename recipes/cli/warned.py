"""Warnings on the command line: one line each, and each only once."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torchrl_tit
from torchrl_tit.settings.checks import printable

_OURS = (str(Path(torchrl_tit.__file__).parent), str(Path(__file__).parents[1]))


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Writes warnings as "warning: TEXT", without the source that Python shows.

    Warnings of other libraries are followed by their location. Python repeats a warning whenever
    the filters have changed, and TorchRL and Gymnasium change them; here each text is printed once.
    """
    shown: set[str] = set()

    def write(
        message: Warning | str, category: type, filename: str, lineno: int, line: str | None = None
    ) -> str:
        text = f"warning: {printable(' '.join(str(message).split()))}"
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
