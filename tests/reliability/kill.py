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
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path

import h5py
import numpy as np

from recipes.cli import main as command_line
from recipes.cql import CQL
from recipes.decision_transformer import DT
from recipes.metrics import read_metrics
from recipes.ppo import PPO
from recipes.recipe import Recipe
from recipes.recipe_json import recipe_to_json
from recipes.sac import SAC
from tests import processes
from tests.recipes.states import TIMES, assert_same
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.files import write_text_atomic
from torchrl_tit.settings.networks import decision_transformer, enhanced_tit, mlp

COLUMNS = ["kind", "run", "event", "seconds", "step", "saving"]

_PPO = PPO(
    name="kill/ppo",
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
_SAC = SAC(
    name="kill/sac",
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
)
_CQL = CQL(
    name="kill/cql",
    env="Reacher-v5",
    dataset="{data}",
    backbone=mlp(),
    total_updates=400,
    batch_size=16,
    critic_hidden=(16,),
    action_samples=2,
    compile="off",
    log_interval=30,
    checkpoint_interval=40,
    evaluation_interval=200,
    evaluation_episodes=2,
)
_DT = DT(
    name="kill/dt",
    env="Reacher-v5",
    dataset="{data}",
    backbone=decision_transformer(4, embed_dim=16, num_blocks=1),
    target_returns=(-4.0,),
    iterations=2,
    updates_per_iteration=200,
    batch_size=8,
    log_interval=30,
    checkpoint_interval=40,
    evaluation_episodes=2,
)
_COLLECTED = replace(_PPO, name="kill/collect", total_steps=64 * 16)


@dataclass(frozen=True)
class Kind:
    """A kind of command to kill."""

    name: str
    kills: int
    words: Callable[[Path, Path], list[str]]
    """The command that begins, given the folder of recipes and data, and the folder to make."""
    online: bool = True
    """Whether it collects steps, so that a resume begins new episodes."""
    resume: bool = True
    """Whether `train --resume` goes on; otherwise the same command does."""


def _train(name: str) -> Callable[[Path, Path], list[str]]:
    return lambda inputs, out: ["train", str(inputs / f"{name}.json"), "--out", str(out)]


def _sweep(inputs: Path, out: Path) -> list[str]:
    return ["sweep", str(inputs / "ppo.json"), "--seeds", "0", "1", "--out", str(out)]


def _collect(inputs: Path, out: Path) -> list[str]:
    return [
        *("data", "collect", "CartPole-v1", "--agent", str(inputs / "collect.json")),
        *("--sets", "random", "mixed", "medium", "--transitions", "600"),
        *("--evaluation-episodes", "2", "--checkpoint-interval", "128", "--out", str(out)),
    ]


RECIPES: dict[str, Recipe] = {
    "ppo": _PPO,
    "compiled": replace(_PPO, compile="on"),
    "sac": _SAC,
    "cql": _CQL,
    "dt": _DT,
    "collect": _COLLECTED,
}
KINDS = [
    Kind("PPO", 20, _train("ppo")),
    Kind("SAC", 10, _train("sac")),
    Kind("CQL", 10, _train("cql"), online=False),
    Kind("DT", 10, _train("dt"), online=False),
    Kind("collect", 10, _collect, resume=False),
    Kind("sweep", 10, _sweep, resume=False),
    Kind("PPO, compiled", 20, _train("compiled")),
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


def check(kind: Kind, run: int, inputs: Path, folder: Path, seed: int) -> Iterator[list[object]]:
    """Runs a command that is killed until it ends, and compares what it made.

    Yields:
        A row for each kill, and one for the end.

    Raises:
        AssertionError: if anything differs, or the command fails.
    """
    whole = folder / "whole"
    words = kind.words(inputs, whole)
    if not (folder / "seconds").exists():
        before = time.monotonic()
        process = begin(words, folder / "whole.log")
        process.join()
        assert process.exitcode == 0, f"{folder / 'whole.log'} says why it failed"
        (folder / "seconds").write_text(str(time.monotonic() - before))
    longest = float((folder / "seconds").read_text())
    kills = 0
    killed = folder / f"killed-{run}"
    shutil.rmtree(killed, ignore_errors=True)  # of a call that was stopped
    generator = random.Random(f"{seed} {kind.name} {run}")
    words = kind.words(inputs, killed)
    while True:
        before = time.monotonic()
        process = begin(words, folder / f"killed-{run}.log")
        seconds = generator.uniform(0, longest)
        process.join(seconds)
        if process.exitcode is not None:
            break
        kill(process)
        kills += 1
        steps = [int(p.name) for p in killed.rglob("checkpoints/*") if p.name.isdigit()]
        saving = any(".tmp" in path.name for path in killed.rglob(".*"))
        yield [kind.name, run, "killed", round(seconds, 2), max(steps, default=0), saving]
        copy = folder / f"copy-{run}"
        shutil.rmtree(copy, ignore_errors=True)
        if kind.online and killed.exists():
            shutil.copytree(killed, copy)
        if kind.resume and (killed / "recipe.json").exists():
            words = ["train", "--resume", str(killed)]
    assert process.exitcode == 0, f"{folder / f'killed-{run}.log'} says why it failed"
    if not kills:  # what the first call compiled need not be compiled again
        (folder / "seconds").write_text(str(time.monotonic() - before))
    if kind.online and kills and copy.exists():
        _resume_copy(kind, inputs, copy, folder / f"copy-{run}.log")
        compare(killed, copy)
        compare_saved(killed, whole)
        shutil.rmtree(copy)
    else:
        compare(whole, killed)
    shutil.rmtree(killed)
    yield [kind.name, run, "identical", "", "", ""]


def _resume_copy(kind: Kind, inputs: Path, copy: Path, log: Path) -> None:
    """Lets a copy of what the last kill left go on to its end."""
    resumes = kind.resume and (copy / "recipe.json").exists()
    process = begin(["train", "--resume", str(copy)] if resumes else kind.words(inputs, copy), log)
    process.join()
    assert process.exitcode == 0, f"{log} says why it failed"


def compare_saved(killed: Path, whole: Path) -> None:
    """Raises AssertionError if a killed command made other files or steps than a whole one."""
    for path in whole.rglob("metrics.csv"):
        other = killed / path.relative_to(whole)
        steps = [[row["step"] for row in read_metrics(one)] for one in (path, other)]
        if "training" not in path.parts:  # which ends where a mark is reached
            assert steps[0] == steps[1], path
    for path in whole.glob("random.hdf5"):  # no training is behind them
        with h5py.File(path) as file, h5py.File(killed / path.name) as other_file:
            for name in file:
                np.testing.assert_array_equal(file[name], other_file[name])


def compare(whole: Path, killed: Path) -> None:
    """Raises AssertionError if what a killed command made differs from the other's."""
    for path in sorted(whole.rglob("*")):
        other = killed / path.relative_to(whole)
        if path.name in ("checkpoints", "replay", "agents") and path.is_dir():
            (step, left), (other_step, right) = load_checkpoint(path), load_checkpoint(other)
            assert step == other_step, path
            assert_same(left, right)
        elif path.name == "metrics.csv":
            left, right = (
                [{k: repr(v) for k, v in row.items() if k not in TIMES} for row in rows]
                for rows in (read_metrics(path), read_metrics(other))
            )
            assert left == right, path
        elif path.name in ("evaluation.json", "evaluations.json"):
            assert path.read_bytes() == other.read_bytes(), path
        elif path.suffix == ".hdf5":
            with h5py.File(path) as file, h5py.File(other) as other_file:
                assert sorted(file) == sorted(other_file), path
                for name in file:
                    np.testing.assert_array_equal(file[name], other_file[name])


def prepare(inputs: Path) -> None:
    """Writes the recipes, and the data of those that train on data."""
    inputs.mkdir(parents=True, exist_ok=True)
    data = ["data", "collect", "Reacher-v5", "--sets", "random", "--transitions", "500"]
    process = begin([*data, "--out", str(inputs / "data")], inputs / "data.log")
    process.join()
    assert process.exitcode == 0, f"{inputs / 'data.log'} says why it failed"
    for name, recipe in RECIPES.items():
        text = recipe_to_json(recipe).replace("{data}", str(inputs / "data" / "random.hdf5"))
        (inputs / f"{name}.json").write_text(text)


def summarize(rows: list[list[str]]) -> str:
    """Returns the table as Markdown."""
    lines = [
        "| what was killed | SIGKILLs | of these while it saved | resumed to the end, the same |",
        "|---|---|---|---|",
    ]
    for kind in KINDS:
        own = [row for row in rows if row[0] == kind.name]
        killed = [row for row in own if row[2] == "killed"]
        saving = sum(row[-1] == "True" for row in killed)
        ended = len({row[1] for row in killed})  # a run that was not compared ends the program
        lines.append(f"| {kind.name} | {len(killed)} of {kind.kills} | {saving} | {ended} |")
    return "\n".join(lines) + "\n"


def read(path: Path) -> list[list[str]]:
    """Reads the rows of earlier calls."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    ended = {tuple(row[:2]) for row in rows if row[2] == "identical"}
    return [row for row in rows if tuple(row[:2]) in ended]  # the others were not compared


def main() -> None:
    """Reads the arguments, kills what earlier calls left, and writes the table after each run."""
    parser = argparse.ArgumentParser("python -m tests.reliability.kill")
    parser.add_argument("--runs", type=Path, default=Path("runs/kill"), help="folder for runs")
    parser.add_argument("--out", type=Path, default=Path("docs/results/reliability"))
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", nargs="+", choices=[kind.name for kind in KINDS])
    options = parser.parse_args()
    processes.use_server()
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    inputs = options.runs.absolute() / "inputs"
    prepare(inputs)
    options.out.mkdir(parents=True, exist_ok=True)
    rows = read(options.out / "kill.csv")
    with (options.out / "kill.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([COLUMNS, *rows])
        for kind in KINDS:
            if options.only is not None and kind.name not in options.only:
                continue
            folder = options.runs.absolute() / kind.name.replace(", ", "-")
            folder.mkdir(parents=True, exist_ok=True)
            ended = [row for row in rows if row[0] == kind.name and row[2] == "identical"]
            run = len(ended)
            while sum(row[0] == kind.name and row[2] == "killed" for row in rows) < kind.kills:
                for row in check(kind, run, inputs, folder, options.seed):
                    writer.writerow(row)
                    file.flush()
                    rows.append([str(cell) for cell in row])
                run += 1
                write_text_atomic(options.out / "kill.md", summarize(rows))
    print((options.out / "kill.md").read_text(), end="")


if __name__ == "__main__":
    main()
