"""A training step on segments, which encode each frame once, compared with full windows.

64 samples, forward, backward and Adam, one thread. Ours reads segments of consecutive steps in
TorchRL's recurrent mode: one of 64, or four of 16, which is the default of the PPO recipes. The
peers read 64 full windows of K frames: this library at the last commit that trained on those, and
the straightforward network. The floor is the time that our step's matrix products would take at the
rate of one large product on this core.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from torchrl_tit import Backbone

from .cases import Case
from .earlier import COMMIT, Worker, earlier_tree
from .matrix_peak import count_flops, peak_flops
from .report import publish, spread, table
from .training_step import make_descent, make_step

SAMPLES, ROUNDS, SECONDS = 64, 5, 0.5


@dataclass(frozen=True)
class Row:
    """A network on segments of one length."""

    case: Case
    length: int
    compiled: bool = False
    straightforward: bool = False


def _row(variant: Any, inputs: Any, num_frames: int, length: int, **options: bool) -> Row:
    return Row(Case(variant, inputs, num_frames, SAMPLES), length, **options)


ROWS = [
    *(_row("Enhanced", "images", k, 64, compiled=True, straightforward=True) for k in (4, 16, 64)),
    *(_row("Enhanced", "images", k, 16) for k in (4, 16, 64)),
    *(_row("Vanilla", "images", k, 64) for k in (4, 16, 64)),
    *(_row("Enhanced", "arrays", k, 64, compiled=True) for k in (16, 64)),
    *(_row("Enhanced", "arrays", k, 16) for k in (16, 64)),
]


def make_segments(case: Case, length: int) -> TensorDictBase:
    """Random segments [N, length]; the history is the window at the start of each."""
    count = case.batch // length
    frames = Case(case.variant, case.inputs, case.num_frames, count).frames(
        case.num_frames - 1 + length
    )
    shape = case.observation_shape
    start = frames[:, : case.num_frames].unsqueeze(1)
    return TensorDict(
        {
            "history": start.expand(count, length, case.num_frames, *shape),
            "observation": frames[:, case.num_frames - 1 :],
            "is_init": torch.zeros(count, length, 1, dtype=torch.bool),
        },
        [count, length],
    )


def make_update(case: Case, length: int, compiled: bool) -> Callable[[], None]:
    """Returns a function that takes one training step on segments."""
    network, segments = case.ours(), make_segments(case, length)
    backbone = Backbone(network, padding="same")

    def loss_of(segments: TensorDictBase) -> Tensor:
        with set_recurrent_mode(True):
            return backbone(segments.copy())["features"].square().mean()

    return make_descent(network, loss_of, segments, compiled)


def milliseconds(update: Callable[[], None], seconds: float) -> float:
    """Returns the milliseconds of processor time of an update, measured over some seconds."""
    steps, start = 0, time.process_time()
    while steps == 0 or time.process_time() - start < seconds:
        update()
        steps += 1
    return 1000 * (time.process_time() - start) / steps


def earlier_setup(case: Case, compiled: bool) -> str:
    """Returns the code that makes the same step at the earlier commit, on full windows."""
    return (
        "import torch\n"
        "torch.set_num_threads(1)\n"
        "from benchmarks.cases import Case\n"
        "from benchmarks.training_step import make_step\n"
        f"case = Case({case.variant!r}, {case.inputs!r}, {case.num_frames}, {case.batch})\n"
        f"windows = case.frames({case.num_frames})\n"
        f"update = make_step(case.ours(), windows, None, compiled={compiled})\n"
    )


@contextmanager
def _peers(row: Row, tree: Path) -> Iterator[dict[str, Callable[[float], float]]]:
    """Yields functions that measure each program for some seconds, warmed up."""
    case = row.case
    with ExitStack() as stack:
        measures: dict[str, Callable[[float], float]] = {}
        for compiled in (False, True) if row.compiled else (False,):
            suffix = ", compiled" if compiled else ""
            update = make_update(case, row.length, compiled)
            update()
            measures["segments" + suffix] = partial(milliseconds, update)
            earlier = Worker(tree, earlier_setup(case, compiled))
            stack.callback(earlier.close)
            earlier.milliseconds(0)
            measures["full windows" + suffix] = earlier.milliseconds
        if row.straightforward:
            step = make_step(case.straightforward(), case.frames(case.num_frames), None, False)
            step()
            measures["straightforward"] = partial(milliseconds, step)
        yield measures


def measure(row: Row, tree: Path, rounds: int, seconds: float) -> dict[str, Any]:
    """Measures a row: milliseconds of each program in each round, alternating."""
    torch.manual_seed(0)
    times: dict[str, list[float]] = {}
    with _peers(row, tree) as measures:
        for _ in range(rounds):
            for name, take in measures.items():
                times.setdefault(name, []).append(take(seconds))
    flops = count_flops(make_update(row.case, row.length, False))
    return {**row.case.record(), "length": row.length, "ms": times, "flops": flops}


def ratios(result: dict[str, Any], peer: str, ours: str) -> list[float]:
    """Returns our speedup in each round; empty if not measured."""
    times = result["ms"]
    if peer not in times:
        return []
    return [a / b for a, b in zip(times[peer], times[ours], strict=True)]


def cells(result: dict[str, Any], rate: float) -> list[str]:
    """Makes the cells of a table row."""
    times = result["ms"]
    compiled = times.get("segments, compiled")
    compared = [
        ratios(result, "full windows", "segments"),
        ratios(result, "full windows, compiled", "segments, compiled"),
        ratios(result, "straightforward", "segments"),
    ]
    floor = 1000 * result["flops"] / rate
    return [
        result["variant"],
        result["inputs"],
        str(result["num_frames"]),
        f"{SAMPLES // result['length']} of {result['length']}",
        f"{floor:.1f}",
        spread(times["segments"], 1),
        spread(compiled, 1) if compiled else "",
        *(spread(values, 2) if values else "" for values in compared),
    ]


def growth(results: list[dict[str, Any]], variant: str, program: str) -> float:
    """Returns the time of a step on images with K = 64, relative to K = 4."""
    medians = {
        result["num_frames"]: statistics.median(result["ms"][program])
        for result in results
        if (result["variant"], result["inputs"], result["length"]) == (variant, "images", SAMPLES)
    }
    return medians[64] / medians[4]


def main(out: Path | None) -> None:
    """Measures on one thread, with an empty compile cache, and reports."""
    torch.set_num_threads(1)
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, TORCHINDUCTOR_CACHE_DIR=cache),
        earlier_tree() as tree,
    ):
        results = [measure(row, tree, ROUNDS, SECONDS) for row in ROWS]
        rate = peak_flops("cpu", torch.float32, size=2048)
    grown = {
        f"{variant}{suffix}": growth(results, variant, "segments" + suffix)
        for variant, suffix in [("Enhanced", ""), ("Enhanced", ", compiled"), ("Vanilla", "")]
    }
    header = [
        "variant",
        "inputs",
        "K",
        "segments",
        "floor",
        "ms a step",
        "ms compiled",
        "full windows",
        "full windows, both compiled",
        "straightforward",
    ]
    markdown = (
        f"# Training on segments\n\n{SAMPLES} samples, forward, backward and Adam, one thread, "
        f"processor time. {ROUNDS} rounds of at least\n{SECONDS} seconds, alternating: median "
        f"(range). The last three columns say how many times as long the\nsame step takes on full "
        f"windows at commit {COMMIT}, eager and compiled, and with the straightforward\nnetwork. "
        f"The floor is the time of our matrix products at {rate / 1e9:.0f} GFLOP/s, the rate of "
        "one large product.\n\n"
        + table(header, [cells(result, rate) for result in results])
        + "\nA step on images with K = 64 takes, in times of one with K = 4 (segments of 64): "
        + ", ".join(f"{name} {value:.2f}" for name, value in grown.items())
        + ".\n"
    )
    publish("segments", markdown, {"rows": results, "growth": grown, "flops_a_second": rate}, out)
