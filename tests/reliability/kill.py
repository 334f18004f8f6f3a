"""Commands that are killed at random moments and resumed, against one that nobody stopped.

``make kill`` trains small recipes of each kind, sends SIGKILL to the command and all that it
started, resumes it, and so on until it ends. On data, checkpoints (networks, optimizers, random
generators), metrics and evaluations must then be the same, bit for bit, as those of a command that
ran in one go. Online, a resumed run begins new episodes: it must end as a copy does that is resumed
from the same folder, with all rows up to the checkpoint. It writes ``kill.csv`` as it goes, a row a
kill, and ``kill.md``.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from recipes.cli import main as command_line
from recipes.core.metrics import read_metrics
from recipes.core.recipe import Recipe
from recipes.core.recipe_json import recipe_to_json
from recipes.cql import CQL
from recipes.decision_transformer import DT
from recipes.ppo import PPO
from recipes.sac import SAC
from tests import processes
from tests.recipes.states import TIMES, assert_same
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.files import write_text_atomic
from torchrl_tit.settings.networks import decision_transformer, enhanced_tit, mlp

COLUMNS = ["kind", "run", "event", "seconds", "step", "saving"]

_OFFLINE: dict[str, Any] = {
    "env": "Reacher-v5",
    "dataset": "{data}",
    "log_interval": 30,
    "checkpoint_interval": 40,
    "evaluation_episodes": 2,
}
_PPO = PPO(
    env="CartPole-v1",
    num_envs=2,
    # Active dropout draws from the global generator too.
    backbone=enhanced_tit(3, embed_dim=8, features_dim=8, ffn_dropout_inner=0.1),
    total_steps=64 * 24,
    steps_per_batch=64,
    minibatch_size=32,
    epochs=2,
    checkpoint_interval=128,
    evaluation_episodes=2,
    compile="off",
)
RECIPES: dict[str, Recipe] = {
    "ppo": _PPO,
    "compiled": replace(_PPO, compile="on"),
    "collect": replace(_PPO, total_steps=64 * 16),
    "sac": SAC(
        env="Pendulum-v1",
        num_envs=2,
        backbone=enhanced_tit(2, embed_dim=8, features_dim=8),
        total_steps=1000,
        random_steps=100,
        batch_size=16,
        buffer_size=500,
        critic_hidden=(16,),
        log_interval=100,
        checkpoint_interval=100,
        evaluation_episodes=2,
    ),
    "cql": CQL(
        backbone=mlp(),
        total_updates=400,
        batch_size=16,
        critic_hidden=(16,),
        action_samples=2,
        compile="off",
        evaluation_interval=200,
        **_OFFLINE,
    ),
    "dt": DT(
        backbone=decision_transformer(4, embed_dim=16, num_blocks=1),
        target_returns=(-4.0,),
        iterations=2,
        updates_per_iteration=200,
        batch_size=8,
        **_OFFLINE,
    ),
}


@dataclass(frozen=True)
class Kind:
    """A kind of command to kill: words in which {inputs} and {out} are folders."""

    name: str
    kills: int
    words: str
    online: bool = True
    """Whether it collects steps, so that a resume begins new episodes."""
    resume: bool = True
    """Whether `train --resume` goes on; otherwise the same command does."""

    def begin(self, inputs: Path, out: Path, log: Path) -> BaseProcess:
        """Begins the command, or goes on with what it has made so far."""
        if self.resume and (out / "recipe.json").exists():
            return begin(["train", "--resume", str(out)], log)
        return begin([word.format(inputs=inputs, out=out) for word in self.words.split()], log)


_TRAIN = "train {{inputs}}/{}.json --out {{out}}"
_COLLECT = """
    data collect CartPole-v1 --agent {inputs}/collect.json --sets random mixed medium
    --transitions 600 --evaluation-episodes 2 --checkpoint-interval 128 --out {out}
"""
KINDS = [
    Kind("PPO", 20, _TRAIN.format("ppo")),
    Kind("SAC", 10, _TRAIN.format("sac")),
    Kind("CQL", 10, _TRAIN.format("cql"), online=False),
    Kind("DT", 10, _TRAIN.format("dt"), online=False),
    Kind("collect", 10, _COLLECT, resume=False),
    Kind("sweep", 10, "sweep {inputs}/ppo.json --seeds 0 1 --out {out}", resume=False),
    Kind("PPO, compiled", 20, _TRAIN.format("compiled")),
]


def begin(words: list[str], log: Path) -> BaseProcess:
    """Starts a command, which is forked from a process that has imported everything."""
    process = multiprocessing.Process(target=_run, args=(words, log))
    process.start()
    return process


def _run(words: list[str], log: Path) -> None:
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    command_line(words)


def end(process: BaseProcess, log: Path) -> None:
    """Waits for a command to end; raises AssertionError if it fails."""
    process.join()
    assert process.exitcode == 0, f"{log} says why it failed"


def kill(process: BaseProcess) -> None:
    """Kills a command and all that it started."""
    assert process.pid is not None
    os.kill(process.pid, signal.SIGSTOP)  # it starts no others meanwhile
    for pid in [*_descendants(process.pid), process.pid]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.join()


def _descendants(pid: int) -> Iterator[int]:
    with suppress(FileNotFoundError):
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            yield from _descendants(int(child))
            yield int(child)


def check(kind: Kind, inputs: Path, folder: Path, generator: random.Random) -> Iterator[list[Any]]:
    """Runs commands that are killed until they end, and compares what they made.

    Yields:
        A row for each kill, and one for each end.

    Raises:
        AssertionError: if anything differs, or a command fails.
    """
    whole, log = folder / "whole", folder / "log"
    before = time.monotonic()
    end(kind.begin(inputs, whole, log), log)
    longest, kills, run = time.monotonic() - before, 0, 0
    while kills < kind.kills:
        killed, copy = folder / f"killed-{run}", folder / f"copy-{run}"
        while True:
            process = kind.begin(inputs, killed, log)
            seconds = generator.uniform(0, longest)
            process.join(seconds)
            if process.exitcode is not None:
                break
            kill(process)
            kills += 1
            steps = [int(p.name) for p in killed.rglob("checkpoints/*") if p.name.isdigit()]
            saving = any(".tmp" in path.name for path in killed.rglob(".*"))
            yield [kind.name, run, "killed", round(seconds, 2), max(steps, default=0), saving]
            shutil.rmtree(copy, ignore_errors=True)
            if kind.online and killed.exists():
                shutil.copytree(killed, copy)
        end(process, log)
        if copy.exists():
            end(kind.begin(inputs, copy, log), log)
            compare(killed, copy)
            compare_saved(killed, whole)
            shutil.rmtree(copy)
        else:
            compare(whole, killed)
        shutil.rmtree(killed)
        yield [kind.name, run, "identical", "", "", ""]
        run += 1


def compare_saved(killed: Path, whole: Path) -> None:
    """Raises AssertionError if a killed command made other files or steps than a whole one."""
    for path in whole.rglob("metrics.csv"):
        other = killed / path.relative_to(whole)
        steps = [[row["step"] for row in read_metrics(one)] for one in (path, other)]
        if "training" not in path.parts:  # which ends where a mark is reached
            assert steps[0] == steps[1], path
    for path in whole.glob("random.hdf5"):  # no training is behind them
        _compare_data(path, killed / path.name)


def compare(whole: Path, killed: Path) -> None:
    """Raises AssertionError if what a killed command made differs from the other's."""
    for path in sorted(whole.rglob("*")):
        other = killed / path.relative_to(whole)
        if path.name in ("checkpoints", "replay", "agents") and path.is_dir():
            assert_same(load_checkpoint(path), load_checkpoint(other))
        elif path.name == "metrics.csv":
            left, right = (
                [{k: repr(v) for k, v in row.items() if k not in TIMES} for row in rows]
                for rows in (read_metrics(path), read_metrics(other))
            )
            assert left == right, path
        elif path.name in ("evaluation.json", "evaluations.json"):
            assert path.read_bytes() == other.read_bytes(), path
        elif path.suffix == ".hdf5":
            _compare_data(path, other)


def _compare_data(path: Path, other: Path) -> None:
    with h5py.File(path) as file, h5py.File(other) as other_file:
        assert sorted(file) == sorted(other_file), path
        for name in file:
            np.testing.assert_array_equal(file[name], other_file[name])


def prepare(inputs: Path) -> None:
    """Writes the recipes, and the data of those that train on data."""
    inputs.mkdir(parents=True)
    data = ["data", "collect", "Reacher-v5", "--sets", "random", "--transitions", "500"]
    log = inputs / "data.log"
    end(begin([*data, "--out", str(inputs / "data")], log), log)
    for name, recipe in RECIPES.items():
        text = recipe_to_json(recipe).replace("{data}", str(inputs / "data" / "random.hdf5"))
        (inputs / f"{name}.json").write_text(text)


def summarize(rows: list[list[Any]]) -> str:
    """Returns the table as Markdown."""
    lines = [
        "| what was killed | SIGKILLs | of these while it saved | resumed to the end, the same |",
        "|---|---|---|---|",
    ]
    for kind in KINDS:
        events = [(row[2], row[-1]) for row in rows if row[0] == kind.name]
        killed = [saving for event, saving in events if event == "killed"]
        ended = len(events) - len(killed)  # a run that was not the same ends the program
        lines.append(f"| {kind.name} | {len(killed)} | {sum(killed)} | {ended} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Reads the arguments, kills commands, and writes the table."""
    parser = argparse.ArgumentParser("python -m tests.reliability.kill")
    parser.add_argument("--runs", type=Path, default=Path("runs/kill"), help="new folder for runs")
    parser.add_argument("--out", type=Path, default=Path("docs/results/reliability"))
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", nargs="+", choices=[kind.name for kind in KINDS])
    options = parser.parse_args()
    if options.runs.exists():
        parser.error(f"--runs {options.runs} exists already: name a new folder")
    processes.use_server()
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    runs = options.runs.absolute()
    prepare(runs / "inputs")
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[list[Any]] = []
    with (options.out / "kill.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for kind in KINDS:
            if options.only is not None and kind.name not in options.only:
                continue
            folder = runs / kind.name.replace(", ", "-")
            folder.mkdir()
            generator = random.Random(f"{options.seed} {kind.name}")
            for row in check(kind, runs / "inputs", folder, generator):
                writer.writerow(row)
                file.flush()
                rows.append(row)
    write_text_atomic(options.out / "kill.md", table := summarize(rows))
    print(table, end="")


if __name__ == "__main__":
    main()
