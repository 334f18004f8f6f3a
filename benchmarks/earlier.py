"""Measures an earlier commit of this library next to the present one.

The commit's files are taken from the clone's own history into a temporary folder. Programs of
either tree run in their own processes, which measure on request, so they take turns.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

COMMIT = "1ab24c0"
"""The last commit that trained on full windows: every frame was encoded K times."""

_WORKER = """
import sys, time
clock = time.process_time
{setup}
update()
for line in sys.stdin:
    steps, start = 0, clock()
    while steps == 0 or clock() - start < float(line):
        update()
        steps += 1
    print("ms", 1000 * (clock() - start) / steps, flush=True)
"""


CLONE = Path(__file__).parents[1]
"""The folder with the present files."""


class Worker:
    """A process that measures an update.

    Args:
        tree: the folder with a commit's files.
        setup: Python code that imports from them, and defines ``update``, a function without
            arguments.
    """

    def __init__(self, tree: Path, setup: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", _WORKER.format(setup=setup)],
            cwd=tree,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def milliseconds(self, seconds: float) -> float:
        """Returns the milliseconds of processor time of an update, measured over some seconds."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith("ms "):
                return float(line.split()[1])
        raise RuntimeError(f"a measuring process ended with code {self._process.wait()}")

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@contextmanager
def earlier_tree() -> Iterator[Path]:
    """Yields a temporary folder with the files of the earlier commit.

    Raises:
        SystemExit: if this is not a clone with that commit.
    """
    command = ["git", "archive", "--format=tar", COMMIT]
    try:
        archive = subprocess.run(command, check=True, capture_output=True, cwd=CLONE).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise SystemExit(
            f"this benchmark compares with commit {COMMIT}, which git does not find here: run it "
            "in a full clone"
        ) from error
    with TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
            tar.extractall(folder, filter="data")
        yield Path(folder)
