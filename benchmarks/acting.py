"""A step of acting: the backbone with cached tokens, compared with encoding the whole window.

Windows advance by one observation per step, as in an environment; every 25 steps, one environment
begins a new episode. Ours is the ``Backbone`` in acting mode, including its comparison of frames,
both eager and with its two parts compiled. The peer is the straightforward network on the same
windows. Times are milliseconds per step; on a CPU, they are the processor time of one thread, which
other programs on the machine hardly affect.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_tit.modules import Backbone

from .cases import COLUMNS, Case
from .report import publish, spread, table
from .straightforward_ratios import HEADER, cells, record

STEPS, REPEATS = 20, 7
CASES = [
    *(Case("Enhanced", "arrays", num_frames, 8) for num_frames in (1, 4, 16, 64)),
    *(Case("Vanilla", "arrays", num_frames, 8) for num_frames in (1, 4, 16, 64)),
    *(Case("Enhanced", "images", num_frames, 8) for num_frames in (1, 4, 16, 64)),
    *(Case("Vanilla", "images", num_frames, 8) for num_frames in (1, 4, 16, 64)),
]
COMPILED = [  # each takes a minute to compile
    *(Case("Enhanced", "images", num_frames, 8) for num_frames in (4, 16, 64)),
    *(Case("Vanilla", "images", num_frames, 8) for num_frames in (4, 64)),
]


def make_windows(case: Case, steps: int, device: str = "cpu") -> list[Tensor]:
    """Makes the windows of consecutive steps, [batch, K, *observation_shape] each."""
    frames = case.frames(steps + case.num_frames - 1)
    windows = [frames[:, step : step + case.num_frames].clone() for step in range(steps)]
    for start in range(10, steps, 25):  # an episode begins: the first frame is repeated
        for step in range(start, min(steps, start + case.num_frames)):
            windows[step][0, : case.num_frames - 1 - (step - start)] = frames[
                0, start + case.num_frames - 1
            ]
    return [window.to(device) for window in windows]


def milliseconds(act: Callable[[Tensor], Any], windows: list[Tensor]) -> float:
    """Returns the milliseconds that a step takes."""
    clock = time.perf_counter if windows[0].is_cuda else time.thread_time
    synchronize(windows[0])
    start = clock()
    for window in windows:
        act(window)
    synchronize(windows[0])
    return 1000 * (clock() - start) / len(windows)


def synchronize(tensor: Tensor) -> None:
    """Waits for a GPU, if the tensor is on one."""
    if tensor.is_cuda:
        torch.cuda.synchronize()


def our_step(
    case: Case, stack: ExitStack, *, compiled: bool, device: str
) -> Callable[[Tensor], object]:
    """Returns our backbone in acting mode, which ends when the stack is closed."""
    backbone = Backbone(case.ours()).eval().to(device)
    if compiled:
        backbone.compile_parts(dynamic=False)
    stack.enter_context(backbone.acting())
    return lambda window: backbone(TensorDict({"history": window}, [len(window)]))


@torch.no_grad()
def measure(
    case: Case, steps: int, repeats: int, *, compiled: bool = False, device: str = "cpu"
) -> dict[str, Any]:
    """Measures ours, ours compiled and the straightforward network, alternating."""
    torch.manual_seed(0)
    other = case.straightforward().eval().to(device)
    with ExitStack() as stack:
        acts = {"ours": our_step(case, stack, compiled=False, device=device)}
        if compiled:
            acts["compiled"] = our_step(case, stack, compiled=True, device=device)
        acts["straightforward"] = other
        times: dict[str, list[float]] = {name: [] for name in acts}
        for _ in range(repeats):
            windows = make_windows(case, steps + 2, device)
            for name, act in acts.items():
                milliseconds(act, windows[:2])  # fills the cache
                times[name].append(milliseconds(act, windows[2:]))
    return {**case.record(), "dtype": "float32", **record(times)}


@torch.no_grad()
def growth(
    case: Case, steps: int, repeats: int, *, compiled: bool = False, device: str = "cpu"
) -> list[float]:
    """Measures how much longer our step takes with K = 64 than in a case, alternating."""
    cases = [case, replace(case, num_frames=64)]
    ratios = []
    with ExitStack() as stack:
        acts = [our_step(each, stack, compiled=compiled, device=device) for each in cases]
        for _ in range(repeats):
            times = []
            for each, act in zip(cases, acts, strict=True):
                windows = make_windows(each, steps + 2, device)
                milliseconds(act, windows[:2])
                times.append(milliseconds(act, windows[2:]))
            ratios.append(times[1] / times[0])
    return ratios


def main(out: Path | None) -> None:
    """Measures on one thread and reports."""
    torch.set_num_threads(1)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows = [
        measure(case, STEPS, REPEATS, compiled=case in COMPILED, device=device) for case in CASES
    ]
    lines = [
        [*case.columns(), *cells(row, ms_digits=2, ratio_digits=1)]
        for case, row in zip(CASES, rows, strict=True)
    ]
    grows = {
        f"{case.variant}, {case.inputs}{', compiled' if compiled else ''}": growth(
            case, STEPS, REPEATS, compiled=compiled, device=device
        )
        for case in CASES
        if case.num_frames == 4
        for compiled in ((False, True) if case in COMPILED else (False,))
    }
    markdown = (
        f"# Acting\n\nMilliseconds a step of all environments together, float32, on {device}"
        f"{' (processor time)' if device == 'cpu' else ''}. {REPEATS} rounds of\n{STEPS} steps, "
        "alternating: median (range); ratios are taken round by round.\n\n"
        + table([*COLUMNS, *HEADER], lines)
        + "\nHow much longer our step takes with K = 64 than with K = 4, both alternating:\n\n"
        + table(["network", "factor"], [[name, spread(x, 2)] for name, x in grows.items()])
    )
    publish("acting", markdown, {"rows": rows, "growth_from_4_to_64": grows}, out)
