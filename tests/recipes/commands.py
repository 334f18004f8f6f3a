"""The command line in a process of its own, without the seconds that importing PyTorch takes."""

import multiprocessing
import os
import resource
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from recipes.cli import main


def fails(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Runs a command that must fail with one line, after at most notes; returns that line."""
    with pytest.raises(SystemExit) as exit_:
        main([str(word) for word in words])
    assert exit_.value.code == 2
    errors = capsys.readouterr().err
    assert "Traceback" not in errors
    assert "usage:" not in errors
    [line] = [line for line in errors.splitlines() if line.startswith("error: ")]
    return line


class Command:
    """A running command.

    Args:
        words: the command and its arguments.
        errors: file for what it writes to standard error.
        file_size: bytes that no file may exceed, as if the disk were full.
        memory: bytes that it may take besides those it begins with, as if there were no more.
    """

    def __init__(
        self,
        words: Sequence[object],
        errors: Path,
        *,
        file_size: int | None = None,
        memory: int | None = None,
    ) -> None:
        self.errors = errors
        # It begins at once: see tests/processes.py. Not a daemon: it may have processes of its own.
        arguments = [str(word) for word in words], errors, file_size, memory
        self._process = multiprocessing.Process(target=_run, args=arguments)
        self._process.start()

    def poll(self) -> int | None:
        """Returns the exit code, negative after a signal; None before the end."""
        self._process.join(0)
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """As that of ``subprocess.Popen``."""
        return self.poll()

    def send_signal(self, number: int) -> None:
        """Sends the process a signal."""
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def wait(self, timeout: float = 120) -> int:
        """Waits for the end, returns the exit code and kills a process that takes longer."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            self._process.kill()
            raise TimeoutError(f"still running after {timeout} s: {self.errors.read_text()}")
        return self._process.exitcode


def _run(words: list[str], errors: Path, file_size: int | None, memory: int | None) -> None:
    os.setsid()
    if memory is not None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    if file_size is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
    with errors.open("w") as file, open(os.devnull, "w") as null:
        os.dup2(null.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    main(words)
