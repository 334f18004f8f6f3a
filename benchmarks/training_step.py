"""A training step (forward, backward and Adam), compared with the straightforward network.

Both train on the same minibatch with the same loss and the same fused Adam. Ours is measured eager
and compiled. In bfloat16 on a CPU, the straightforward network runs under the same autocast. Times
are milliseconds per step.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from .acting import synchronize
from .cases import COLUMNS, Case
from .matrix_peak import count_flops, peak_flops
from .report import publish, table
from .straightforward_ratios import HEADER, cells, record

CASES = [
    *(Case("Enhanced", "arrays", num_frames, 64) for num_frames in (1, 4, 16, 64)),
    *(Case("Vanilla", "arrays", num_frames, 64) for num_frames in (1, 4, 16, 64)),
    *(Case("Enhanced", "images", num_frames, 64) for num_frames in (1, 4, 16, 64)),
    *(Case("Vanilla", "images", num_frames, 64) for num_frames in (1, 4, 16, 64)),
]
COMPILED = [  # each takes a minute to compile
    Case("Enhanced", "arrays", 1, 64),
    Case("Enhanced", "arrays", 16, 64),
    Case("Enhanced", "images", 4, 64),
]
GPU_CASES = [Case("Enhanced", "images", 4, 1024)]
REPEATS, SECONDS = 7, 0.5


def make_step(
    network: nn.Module, history: Tensor, autocast: torch.dtype | None, compiled: bool
) -> Callable[[], None]:
    """Returns a function that takes one training step."""

    def loss_of(history: Tensor) -> Tensor:
        with torch.autocast(history.device.type, autocast) if autocast else nullcontext():
            return network(history).float().square().mean()

    return make_descent(network, loss_of, history, compiled)


def make_descent(
    network: nn.Module, loss_of: Callable[[Any], Tensor], inputs: Any, compiled: bool
) -> Callable[[], None]:
    """Returns a function that takes one Adam step on a loss of its inputs."""
    optimizer = torch.optim.Adam(network.parameters(), fused=True)
    loss = torch.compile(loss_of, dynamic=False) if compiled else loss_of

    def step() -> None:
        optimizer.zero_grad()
        loss(inputs).backward()
        optimizer.step()

    return step


def milliseconds(step: Callable[[], None], history: Tensor, seconds: float) -> float:
    """Returns the milliseconds that a step takes, measured over about ``seconds``."""
    synchronize(history)
    steps, start = 0, time.perf_counter()
    while steps == 0 or time.perf_counter() - start < seconds:
        step()
        steps += 1
        synchronize(history)
    return 1000 * (time.perf_counter() - start) / steps


def measure(
    case: Case,
    repeats: int,
    seconds: float,
    *,
    compiled: bool,
    bfloat16: bool = False,
    device: str = "cpu",
) -> dict[str, Any]:
    """Measures ours, ours compiled and the straightforward network, alternating."""
    torch.manual_seed(0)
    history = case.frames(case.num_frames).to(device)
    autocast = torch.bfloat16 if bfloat16 else None
    steps = {
        "ours": make_step(case.ours().to(device), history, autocast, compiled=False),
        # On a GPU, the peer is float32, as in a first implementation.
        "straightforward": make_step(
            case.straightforward().to(device),
            history,
            autocast if device == "cpu" else None,
            compiled=False,
        ),
    }
    compile_seconds = float("nan")
    if compiled:
        steps["compiled"] = make_step(case.ours().to(device), history, autocast, compiled=True)
        start = time.perf_counter()
        steps["compiled"]()
        synchronize(history)
        compile_seconds = time.perf_counter() - start
    for step in steps.values():
        step()
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            times[name].append(milliseconds(step, history, seconds))
    dtype = "bfloat16" if bfloat16 else "float32"
    row: dict[str, Any] = {**case.record(), "dtype": dtype, **record(times)}
    if device == "cuda":
        flops = count_flops(steps["ours"])
        peak = peak_flops(device, autocast or torch.float32)
        row["peak_shares"] = {
            name: 1000 * flops / statistics.median(times[name]) / peak
            for name in times
            if name != "straightforward"
        }
    return row | ({"compile_seconds": compile_seconds} if compiled else {})


def main(out: Path | None) -> None:
    """Measures with an empty compile cache, so that compile times are measured too."""
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, TORCHINDUCTOR_CACHE_DIR=cache),
    ):
        report(out)


def report(out: Path | None) -> None:
    """Measures on one thread, or on a GPU, and reports."""
    torch.set_num_threads(1)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    cases = [(case, case in COMPILED, False) for case in CASES]
    cases.append((Case("Enhanced", "images", 4, 64), True, True))
    if device == "cuda":
        cases += [(case, True, True) for case in GPU_CASES]
    rows = [
        measure(case, REPEATS, SECONDS, compiled=compiled, bfloat16=bfloat16, device=device)
        for case, compiled, bfloat16 in cases
    ]
    lines = [
        [
            *case.columns(),
            *cells(row, ms_digits=1, ratio_digits=2),
            f"{row['compile_seconds']:.0f} s" if compiled else "",
        ]
        for (case, compiled, _), row in zip(cases, rows, strict=True)
    ]
    markdown = (
        f"# Training step\n\nMilliseconds a step on {device}, dropout off. {REPEATS} rounds of "
        f"{SECONDS} seconds each, alternating:\nmedian (range); ratios are taken round by round."
        "\n\n" + table([*COLUMNS, *HEADER, "compiling"], lines)
    )
    if device == "cuda":
        last = rows[-1]["peak_shares"]
        markdown += "\nOf the rate of one large matrix product, the last row's step reaches: " + (
            ", ".join(f"{name} {100 * share:.1f} %" for name, share in last.items()) + ".\n"
        )
    publish("training_step", markdown, {"rows": rows}, out)
