"""A step of acting: the backbone with kept tokens, against the whole window encoded each time.

Windows move on by one observation a step, as environments hand them over; every 25 steps one
environment starts anew. Ours is the ``Backbone`` in acting mode, checks of frames and weights
included, as it is and with its two parts compiled; the other is the straightforward network on the
same windows. Milliseconds a step.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_tit.modules import Backbone

from .cases import COLUMNS, Case
from .report import publish, spread, table

STEPS, REPEATS = 20, 7
CASES = [
    *(Case("Enhanced", "arrays", history, 8) for history in (1, 4, 16, 64)),
    *(Case("Vanilla", "arrays", history, 8) for history in (1, 4, 16, 64)),
    *(Case("Enhanced", "images", history, 8) for history in (1, 4, 16, 64)),
    *(Case("Vanilla", "images", history, 8) for history in (1, 4, 16, 64)),
]
COMPILED = [  # each takes a minute to compile
    *(Case("Enhanced", "images", history, 8) for history in (4, 16, 64)),
    *(Case("Vanilla", "images", history, 8) for history in (4, 64)),
]


def make_windows(case: Case, steps: int, device: str = "cpu") -> list[Tensor]:
    """Windows [batch, K, *observation_shape] of so many steps."""
    frames = case.frames(steps + case.history - 1)
    windows = [frames[:, step : step + case.history].clone() for step in range(steps)]
    for start in range(10, steps, 25):  # the first environment starts anew, with copies
        for step in range(start, min(steps, start + case.history)):
            windows[step][0, : case.history - 1 - (step - start)] = frames[
                0, start + case.history - 1
            ]
    return [window.to(device) for window in windows]


def milliseconds(act: Callable[[Tensor], Any], windows: list[Tensor]) -> float:
    """Milliseconds a step."""
    synchronize(windows[0])
    start = time.perf_counter()
    for window in windows:
        act(window)
    synchronize(windows[0])
    return 1000 * (time.perf_counter() - start) / len(windows)


def synchronize(tensor: Tensor) -> None:
    """Waits for a GPU, if the tensor is on one."""
    if tensor.is_cuda:
        torch.cuda.synchronize()


def measure(
    case: Case, steps: int, repeats: int, *, compiled: bool = False, device: str = "cpu"
) -> dict[str, Any]:
    """Measures ours, ours compiled, and the straightforward network, alternating."""
    torch.manual_seed(0)
    other = case.straightforward().eval().to(device)
    backbones = {"ours": Backbone(case.ours()).eval().to(device)}
    if compiled:
        backbones["compiled"] = Backbone(case.ours()).eval().to(device)
        backbones["compiled"].compile_parts(dynamic=False)
    times: dict[str, list[float]] = {name: [] for name in (*backbones, "straightforward")}
    with torch.no_grad(), ExitStack() as stack:
        for backbone in backbones.values():
            stack.enter_context(backbone.acting())
        for _ in range(repeats):
            windows = make_windows(case, steps + 2, device)
            for name, backbone in backbones.items():

                def act(window: Tensor, backbone: Backbone = backbone) -> None:
                    backbone(TensorDict({"history": window}, [len(window)]))

                milliseconds(act, windows[:2])  # fills what is kept
                times[name].append(milliseconds(act, windows[2:]))
            milliseconds(other, windows[:1])
            times["straightforward"].append(milliseconds(other, windows[2:]))
    row: dict[str, Any] = {**case.record(), "dtype": "float32"}
    for name, values in times.items():
        row[f"{name}_ms"] = values
        if name != "straightforward":
            ratios = [b / a for a, b in zip(values, times["straightforward"], strict=True)]
            row |= {f"{name}_ratios": ratios, f"{name}_median_ratio": statistics.median(ratios)}
    return row


def growth(rows: list[dict[str, Any]], variant: str, inputs: str, name: str) -> float:
    """How much longer our step takes with K = 64 than with K = 4."""
    time_of = {
        row["history"]: statistics.median(row[f"{name}_ms"])
        for row in rows
        if (row["variant"], row["inputs"]) == (variant, inputs) and f"{name}_ms" in row
    }
    return time_of[64] / time_of[4]


def cells(row: dict[str, Any]) -> list[str]:
    """What a row of the table says of the times."""
    compiled = "compiled_ms" in row
    return [
        row["dtype"],
        spread(row["ours_ms"], 2),
        spread(row["compiled_ms"], 2) if compiled else "",
        spread(row["straightforward_ms"], 2),
        spread(row["ours_ratios"], 1),
        spread(row["compiled_ratios"], 1) if compiled else "",
    ]


def main(out: Path | None) -> None:
    """Measures on one thread and reports."""
    torch.set_num_threads(1)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows = [
        measure(case, STEPS, REPEATS, compiled=case in COMPILED, device=device) for case in CASES
    ]
    lines = [[*case.columns(), *cells(row)] for case, row in zip(CASES, rows, strict=True)]
    grows = {
        f"{variant}, {inputs}": growth(rows, variant, inputs, "ours")
        for inputs in ("arrays", "images")
        for variant in ("Enhanced", "Vanilla")
    } | {
        f"{variant}, images, compiled": growth(rows, variant, "images", "compiled")
        for variant in ("Enhanced", "Vanilla")
    }
    header = ["dtype", "ours", "ours, compiled", "straightforward", "ratio", "ratio, compiled"]
    markdown = (
        f"# Acting\n\nMilliseconds a step of all environments together, float32, on {device}. "
        f"{REPEATS} rounds of\n{STEPS} steps, alternating: median (range); ratios are taken round "
        "by round.\n\n"
        + table([*COLUMNS, *header], lines)
        + "\nFrom K = 4 to K = 64 our step takes longer by these factors: "
        + ", ".join(f"{name} {factor:.2f}" for name, factor in grows.items())
        + ".\n"
    )
    publish("acting", markdown, {"rows": rows, "growth_from_4_to_64": grows}, out)
