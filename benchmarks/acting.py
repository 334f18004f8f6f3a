"""A step of acting: the backbone with kept tokens, against the whole window encoded each time.

Windows move on by one observation a step, as environments hand them over; every 25 steps one
environment starts anew. Ours is the ``Backbone`` in acting mode, checks of frames and weights
included; the other is the straightforward network on the same windows. Milliseconds a step.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
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


def measure(case: Case, steps: int, repeats: int, device: str = "cpu") -> dict[str, Any]:
    """Measures both, alternating."""
    torch.manual_seed(0)
    backbone = Backbone(case.ours()).eval().to(device)
    other = case.straightforward().eval().to(device)
    pairs = []
    with torch.no_grad(), backbone.acting():

        def ours(window: Tensor) -> None:
            backbone(TensorDict({"history": window}, [len(window)]))

        for _ in range(repeats):
            windows = make_windows(case, steps + 2, device)
            milliseconds(ours, windows[:2])  # fills what is kept
            milliseconds(other, windows[:1])
            pairs.append((milliseconds(ours, windows[2:]), milliseconds(other, windows[2:])))
    mine, others = (list(column) for column in zip(*pairs, strict=True))
    ratios = [b / a for a, b in pairs]
    return {
        **case.record(),
        "dtype": "float32",
        "ours_ms": mine,
        "straightforward_ms": others,
        "ratios": ratios,
        "median_ratio": statistics.median(ratios),
    }


def growth(rows: list[dict[str, Any]], variant: str, inputs: str) -> float:
    """How much longer our step takes with K = 64 than with K = 4."""
    time_of = {
        row["history"]: statistics.median(row["ours_ms"])
        for row in rows
        if (row["variant"], row["inputs"]) == (variant, inputs)
    }
    return time_of[64] / time_of[4]


def main(out: Path | None) -> None:
    """Measures on one thread and reports."""
    torch.set_num_threads(1)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows = [measure(case, STEPS, REPEATS, device) for case in CASES]
    lines = [
        [
            *case.columns(),
            spread(row["ours_ms"], 2),
            spread(row["straightforward_ms"], 2),
            spread(row["ratios"], 1),
        ]
        for case, row in zip(CASES, rows, strict=True)
    ]
    grows = {
        f"{variant}, {inputs}": growth(rows, variant, inputs)
        for inputs in ("arrays", "images")
        for variant in ("Enhanced", "Vanilla")
    }
    markdown = (
        f"# Acting\n\nMilliseconds a step of all environments together, float32, on {device}. "
        f"{REPEATS} rounds of\n{STEPS} steps, alternating: median (range).\n\n"
        + table([*COLUMNS, "ours", "straightforward", "ratio, round by round"], lines)
        + "\nFrom K = 4 to K = 64 our step takes longer by these factors: "
        + ", ".join(f"{name} {factor:.2f}" for name, factor in grows.items())
        + ".\n"
    )
    publish("acting", markdown, {"rows": rows, "growth_from_4_to_64": grows}, out)
