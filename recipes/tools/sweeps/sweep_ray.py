"""The runs of a sweep on the machines of a Ray cluster, which share a file system.

Each run has an actor, which starts the run in its own process, as a sweep on one machine does. The
sweep polls the actor until the run ends.
"""

from __future__ import annotations

import os
import platform
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...core.interrupt import raise_on_signals
from .sweep import PROGRAM, Job


def find_unmet_needs(jobs: Iterable[Job]) -> list[str]:
    """Names the runs that no machine of the cluster has enough CPUs or GPUs for, and why."""
    import ray

    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    return [
        f"{job.folder} waits until a machine with {needs['CPU']} CPUs and {needs['GPU']} GPUs joins"
        for job in jobs
        for needs in [_needs(job)]
        if not any(all(has.get(kind, 0) >= needs[kind] for kind in needs) for has in machines)
    ]


class RayWorker:
    """A run on a machine of the cluster; it waits in Ray's queue until one has room for it.

    It takes as many CPUs as the recipe has threads, and a GPU if the recipe's device is "cuda" or
    one of its GPUs, or "auto" and the cluster has GPUs.

    Args:
        job: the run.
    """

    def __init__(self, job: Job) -> None:
        import ray

        needs = _needs(job)
        job.log.parent.mkdir(parents=True, exist_ok=True)
        job.log.touch()
        self.log = job.log
        self.has_begun = False
        self._code: int | None = None
        actor: Any = ray.remote(_actor_class())
        self._actor = actor.options(num_cpus=needs["CPU"], num_gpus=needs["GPU"]).remote(
            f"{__package__}.sweep_ray", job.arguments(), Path.cwd(), job.log.absolute()
        )
        self._answer = self._actor.poll.remote()

    def poll(self) -> int | None:
        """Returns the exit code, which is 0 if the run is complete; None before the end."""
        import ray

        if self._code is None and ray.wait([self._answer], timeout=0)[0]:
            try:
                self._code = ray.get(self._answer)
                self.has_begun = True
                self._answer = self._actor.poll.remote()
            except ray.exceptions.RayError as error:
                self._code = 1
                with self.log.open("a", encoding="utf-8") as log:
                    log.write(f"error: the worker died: {error}\n")
        return self._code

    def send_signal(self, number: int, /) -> None:
        """Sends the process a signal; a run that has not begun is cancelled."""
        import ray

        if self.has_begun:
            self._actor.send_signal.remote(number)
        else:
            ray.kill(self._actor)
            self._code = -number

    def wait(self) -> int:
        """Waits for the process's end and returns its exit code."""
        while (code := self.poll()) is None:
            time.sleep(0.2)
        return code


def _needs(job: Job) -> dict[str, int]:
    import ray

    device = job.recipe.device
    some = device == "auto" and ray.cluster_resources().get("GPU", 0) > 0
    gpu = some or device.startswith("cuda")
    return {"CPU": job.recipe.threads, "GPU": int(gpu)}


def count_begun(workers: Iterable[RayWorker]) -> int:
    """Counts the runs that have a machine."""
    return sum(worker.has_begun for worker in workers)


def _actor_class() -> type:
    """The actor that starts a run's process. The class is local, so that Ray sends its code.

    Otherwise the actor would needlessly import this package, and with it PyTorch.
    """

    class Actor:
        def __init__(self, module: str, arguments: list[str], folder: Path, log: Path) -> None:
            if not (folder.is_dir() and log.is_file()):
                raise FileNotFoundError(
                    f"{platform.node()} does not see {folder} with {log}: the machines of the "
                    "cluster must share a file system"
                )
            with log.open("ab") as file:
                # The pipe to the process breaks when this process dies, however it dies.
                self.process = subprocess.Popen(
                    [sys.executable, "-m", module, *arguments],
                    cwd=folder,
                    stdin=subprocess.PIPE,
                    stdout=file,
                    stderr=file,
                    start_new_session=True,
                )

        def poll(self) -> int | None:
            try:
                return self.process.wait(timeout=0.5)
            except subprocess.TimeoutExpired:
                return None

        def send_signal(self, number: int) -> None:
            self.process.send_signal(number)

    return Actor


def _main() -> None:
    """Runs the command line, and stops it as Ctrl-C would once its actor is gone."""

    def follow() -> None:
        os.read(sys.stdin.fileno(), 1)
        os.kill(os.getpid(), signal.SIGINT)

    # Where Ray blocks SIGINT in its workers, their processes inherit that.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    with raise_on_signals():
        threading.Thread(target=follow, daemon=True).start()
        runpy.run_module(PROGRAM, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _main()
