"""Long runs of several kinds side by side: what memory, open files and speed do over time.

``make soak`` runs PPO, CQL and two memory tasks for two hours and samples each every 30 seconds:

- ``soak.csv``: a row a sample, written as it is taken, so that a shorter run says something too;
- ``soak.md``: slopes over time with 95 % intervals. What leaks has a slope above zero.

Resident memory has two parts. A run's own memory is what it has allocated, with what the allocator
keeps of freed memory until the next checkpoint returns it; what a run still uses is the least of
it in a while. Pages of files are mostly the code of libraries: the kernel takes them from a process
that waits and reads them again.
Speed is steps per second of processor time, which other work on the machine changes little.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import stats

from torchrl_tit.files import write_text_atomic

COLUMNS = ["run", "seconds", "memory_mb", "file_mb", "descriptors", "processor_seconds", "steps"]
MEASURES: dict[str, tuple[str, Callable[[np.ndarray], np.floating]]] = {
    "memory of its own, MB": ("memory_mb", np.mean),
    "least memory of its own, MB": ("memory_mb", np.min),
    "pages of files, MB": ("file_mb", np.mean),
    "open files": ("descriptors", np.mean),
}
"""What is fitted: a column, and how the samples of a block are summarized."""
_BLOCKS = 12
"""Blocks of time whose means are fitted: neighboring samples are not independent."""
_FOREVER = "1000000000"
_ENDLESS_CQL = ("--total-updates", _FOREVER, "--checkpoint-interval", "100")
"""Checkpoints as often as the other runs write them, by time: each returns free memory."""

_TASKS = {
    "PPO": ["ppo/cartpole/enhanced-tit", "--num-envs", "8", "--total-steps", _FOREVER],
    "CQL": ["cql/hopper-medium-v0/mlp", "--env", "Reacher-v5", "--dataset", "{data}/random.hdf5"],
    "LSTM": ["ppo/cartpole-no-velocity/lstm", "--num-envs", "8", "--total-steps", _FOREVER],
    "images": ["ppo/memory-s7/enhanced-tit", "--total-steps", _FOREVER],
}
_DATA = ["data", "collect", "Reacher-v5", "--sets", "random", "--transitions", "2000"]
_PROGRAM = [sys.executable, "-m", "recipes"]


@dataclass
class Worker:
    """A run in a process of its own."""

    name: str
    folder: Path
    process: subprocess.Popen[bytes]

    def sample(self, begin: float) -> list[object]:
        """Reads what the run takes from the machine, and how far it is."""
        root = Path("/proc", str(self.process.pid))
        status = dict(line.split(":", 1) for line in (root / "status").read_text().splitlines())
        kilobytes = {
            field: int(value.split()[0])
            for field, value in status.items()
            if field.startswith("Rss")
        }
        times = (root / "stat").read_text().rpartition(")")[2].split()[11:15]
        return [
            self.name,
            round(time.monotonic() - begin, 1),
            round(kilobytes["RssAnon"] * 1024 / 1e6, 3),
            round((kilobytes["RssFile"] + kilobytes["RssShmem"]) * 1024 / 1e6, 3),
            len(list((root / "fd").iterdir())),
            sum(map(int, times)) / os.sysconf("SC_CLK_TCK"),
            last_step(self.folder / "metrics.csv"),
        ]


def last_step(path: Path) -> int:
    """The step in the last whole row of a ``metrics.csv``; 0 before the first."""
    if not path.exists():
        return 0
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 4096))
        lines = file.read().split(b"\n")[:-1]
    step = lines[-1].partition(b",")[0]
    return int(step) if step.isdigit() else 0


def soak(folder: Path, out: Path, minutes: float, interval: float) -> None:
    """Runs all tasks until the time is over, and samples them."""
    subprocess.run([*_PROGRAM, *_DATA, "--out", str(folder / "data")], check=True)
    workers = []
    for name, words in _TASKS.items():
        run = folder / name
        words = [word.format(data=folder / "data") for word in words]
        more = _ENDLESS_CQL if name == "CQL" else ()
        command = [*_PROGRAM, "train", *words, *more, "--compile", "off", "--out", str(run)]
        with (folder / f"{run.name}.log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        workers.append(Worker(name, run, process))
    begin = time.monotonic()
    try:
        with (out / "soak.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            while time.monotonic() - begin < 60 * minutes:
                time.sleep(interval)
                for worker in workers:
                    if worker.process.poll() is not None:
                        raise RuntimeError(f"{worker.name} has ended: see {folder}")
                    writer.writerow(worker.sample(begin))
                file.flush()
    finally:
        for worker in workers:
            worker.process.send_signal(signal.SIGINT)
        for worker in workers:
            worker.process.wait()


def summarize(path: Path) -> str:
    """Returns the table of slopes as Markdown.

    Args:
        path: ``soak.csv``, of a run that may still go on.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    lines = [
        "| run | minutes | steps | what | mean | slope per hour | 95 % interval | zero within it |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row["run"] for row in rows):
        samples = {
            c: np.array([float(r[c]) for r in rows if r["run"] == name]) for c in COLUMNS[1:]
        }
        hours = samples["seconds"] / 3600
        # Before the first steps it imports and builds; then caches and allocators fill.
        begun = int((samples["steps"] > 0).argmax())
        begun = int((hours >= hours[begun] + (hours[-1] - hours[begun]) / 10).argmax())
        edges = np.linspace(begun, len(hours) - 1, _BLOCKS + 1).astype(int)
        if edges[1] - edges[0] < 2:
            lines.append(f"| {name} | {60 * hours[-1]:.0f} | too few samples yet | | | | | |")
            continue
        blocks = [slice(*pair) for pair in pairwise(edges)]
        times = np.array([hours[block].mean() for block in blocks])
        took = np.diff(samples["processor_seconds"][edges])
        fitted = {
            what: np.array([summary(samples[column][block]) for block in blocks])
            for what, (column, summary) in MEASURES.items()
        }
        fitted["steps per processor second"] = np.diff(samples["steps"][edges]) / took.clip(1e-9)
        for what, values in fitted.items():
            fit = stats.linregress(times, values)
            spread = np.nan_to_num(fit.stderr) * stats.t.ppf(0.975, _BLOCKS - 2)
            zero = "yes" if abs(fit.slope) <= spread else "no"
            lines.append(
                f"| {name} | {60 * (hours[-1] - hours[begun]):.0f} | {samples['steps'][-1]:.0f} "
                f"| {what} | {values.mean():.1f} | {fit.slope:+.2f} | ± {spread:.2f} | {zero} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Reads the arguments, measures, and writes the table."""
    parser = argparse.ArgumentParser("python -m tests.reliability.soak")
    parser.add_argument("--minutes", type=float, default=120)
    parser.add_argument("--interval", type=float, default=30, help="seconds between samples")
    parser.add_argument("--runs", type=Path, default=Path("runs/soak"), help="new folder for runs")
    parser.add_argument("--out", type=Path, default=Path("docs/results/reliability"))
    parser.add_argument("--table", action="store_true", help="only write the table of --out")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.table:
        if options.runs.exists():
            parser.error(f"--runs {options.runs} exists already: name a new folder")
        options.runs.mkdir(parents=True)
        soak(options.runs, options.out, options.minutes, options.interval)
    table = summarize(options.out / "soak.csv")
    write_text_atomic(options.out / "soak.md", table)
    print(table, end="")


if __name__ == "__main__":
    main()
