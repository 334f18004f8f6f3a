"""Sweeps on a Ray cluster: two machines, which are both this one."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Thread

import pytest

from recipes.core import ray_cluster
from recipes.core.metrics import read_metrics
from recipes.core.ray_cluster import ask_for_machines
from recipes.tools.sweeps import sweep_ray
from recipes.tools.sweeps.sweep import Job, run_jobs
from recipes.tools.sweeps.sweep_ray import RayWorker, count_begun, find_unmet_needs
from tests.recipes.commands import fails
from tests.recipes.small import TINY
from tests.recipes.sweeps.sweep_runs import begin
from torchrl_tit.checkpoint import checkpoint_steps

ROOT = Path(__file__).parents[3]
LONG = replace(TINY, total_steps=1_000_000, compile="off")

# What `sweep --ray ADDRESS` does, with runs that are there already.
DRIVER = """
import sys
from pathlib import Path
from recipes.core.run import Run
from recipes.tools.sweeps.sweep import Job, run_jobs
from recipes.core.ray_cluster import connect
from recipes.tools.sweeps.sweep_ray import RayWorker

connect(sys.argv[1])
run_jobs([Job(Run.open(Path(f)).recipe, Path(f)) for f in sys.argv[2:]], 9, RayWorker)
"""


def meanwhile(act: Callable[[], None]) -> None:
    """Does something beside the sweep, which is not left alone if that fails."""

    def guarded() -> None:
        try:
            act()
        except BaseException:
            os.kill(os.getpid(), signal.SIGINT)
            raise

    Thread(target=guarded, daemon=True).start()


def wait_until_trained(job: Job) -> None:
    metrics = job.folder / "metrics.csv"
    before = len(metrics.read_text().splitlines()) if metrics.exists() else 1
    while not (metrics.exists() and len(metrics.read_text().splitlines()) > before):
        time.sleep(0.05)


def actor_of(job: Job) -> int:
    """The process that started the run's."""
    table = subprocess.run(["ps", "-ewwo", "ppid,args"], capture_output=True, text=True).stdout
    [line] = [line for line in table.splitlines() if line.endswith(f"--resume {job.folder}")]
    return int(line.split()[0])


@pytest.mark.slow
def test_a_sweep_goes_on_after_its_driver_was_killed_and_stops_at_ctrl_c(
    cluster: str, tmp_path: Path
) -> None:
    short = begin(tmp_path / "seed-0", TINY)
    long = begin(tmp_path / "seed-1", LONG)
    command = [sys.executable, "-c", DRIVER, cluster, str(short.folder), str(long.folder)]
    driver = subprocess.Popen(command, cwd=ROOT)
    while not (short.is_complete() and checkpoint_steps(long.folder / "checkpoints")):
        assert driver.poll() is None, long.log.read_text()
        time.sleep(0.05)
    driver.kill()
    driver.wait()
    queued = begin(tmp_path / "seed-2", replace(LONG, threads=2))  # more than a machine has
    finished = (short.folder / "evaluation.json").stat().st_mtime_ns

    def press_ctrl_c() -> None:
        wait_until_trained(long)
        os.kill(os.getpid(), signal.SIGINT)

    meanwhile(press_ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        run_jobs([short, queued, long], 9, RayWorker, count_begun)
    assert (short.folder / "evaluation.json").stat().st_mtime_ns == finished
    assert not long.is_in_use()
    steps = [row["step"] for row in read_metrics(long.folder / "metrics.csv")]
    assert steps == [64 * (i + 1) for i in range(len(steps))]  # none lost, none twice
    assert checkpoint_steps(long.folder / "checkpoints")[-1] == steps[-1]
    assert "stopped; to resume: " in long.log.read_text()
    assert queued.log.read_text() == ""


@pytest.mark.slow
def test_a_cluster_takes_no_one_without_its_token(
    cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(ask_for_machines(cluster)) == 2
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    with pytest.raises(ValueError, match="have no authentication token in common: `ray get-auth"):
        ask_for_machines(cluster)


@pytest.mark.slow
def test_runs_that_fail_or_whose_worker_dies_are_named(cluster: str, tmp_path: Path) -> None:
    killed = begin(tmp_path / "seed-0", LONG)
    damaged = begin(tmp_path / "seed-1", TINY)
    (damaged.folder / "checkpoints" / "000000000064").mkdir(parents=True)  # no checkpoint of ours

    def kill() -> None:
        wait_until_trained(killed)
        os.kill(actor_of(killed), signal.SIGKILL)

    meanwhile(kill)
    failed = run_jobs([killed, damaged], 9, RayWorker, count_begun)
    assert set(failed) == {killed, damaged}
    assert "error: " in damaged.log.read_text()
    assert "error: the worker died" in killed.log.read_text()
    while killed.is_in_use():  # the run's own process saves a checkpoint and stops
        time.sleep(0.05)
    last = list(read_metrics(killed.folder / "metrics.csv"))[-1]["step"]
    assert checkpoint_steps(killed.folder / "checkpoints")[-1] == last


def test_a_run_can_be_stopped_where_ray_blocks_sigint(monkeypatch: pytest.MonkeyPatch) -> None:
    def train_without_worker() -> None:
        worker.close()
        time.sleep(60)

    def run(*_: object, **__: object) -> None:
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        with pytest.raises(KeyboardInterrupt):
            train_without_worker()

    reading, writing = os.pipe()
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
    try:
        with open(reading) as stdin, open(writing, "w") as worker:
            monkeypatch.setattr(sys, "stdin", stdin)
            monkeypatch.setattr("runpy.run_module", run)
            sweep_ray._main()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def test_runs_that_fit_no_machine_are_named(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")
    machines = [{"CPU": 1.0}, {"CPU": 4.0, "GPU": 1.0}, {"CPU": 2.0}]
    nodes = [{"Alive": i != 1, "Resources": has} for i, has in enumerate(machines)]
    monkeypatch.setattr(ray, "nodes", lambda: nodes)
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 3.0})
    jobs = [
        Job(replace(TINY, threads=2), tmp_path / "a"),
        Job(replace(TINY, threads=3), tmp_path / "b"),
        Job(replace(TINY, device="cuda"), tmp_path / "c"),
        Job(replace(TINY, device="auto"), tmp_path / "d"),  # the processor, where there is no GPU
    ]
    cpus, gpus = find_unmet_needs(jobs)
    assert "b waits until a machine with 3 CPUs and 0 GPUs" in cpus
    assert "c waits until a machine with 1 CPUs and 1 GPUs" in gpus


def test_without_ray_the_message_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'torchrl-tit[ray]'" in fails(
        capsys, "sweep", "ppo/cartpole/mlp", "--out", str(tmp_path / "out"), "--ray", "auto"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("127.0.0.1:1", "no Ray cluster answered at '127.0.0.1:1'"),
        ("nowhere", "no connection to Ray at 'nowhere': ValueError: .*nowhere"),
    ],
)
def test_addresses_without_a_cluster_are_refused(monkeypatch, address, reason):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    monkeypatch.setattr(ray_cluster, "_PATIENCE", 30.0 if address == "nowhere" else 2.0)
    with pytest.raises(ValueError, match=reason):
        ask_for_machines(address)


def test_who_has_no_token_is_told_where_it_comes_from(monkeypatch, tmp_path):
    pytest.importorskip("ray")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match="no authentication token in common: `ray get-auth-token"):
        ask_for_machines("127.0.0.1:1")


def test_a_machine_that_does_not_see_the_folder_says_so(tmp_path):
    actor = sweep_ray._actor_class()
    with pytest.raises(FileNotFoundError, match="must share a file system"):
        actor("recipes.tools.sweeps.sweep_ray", [], tmp_path, tmp_path / "missing.log")
