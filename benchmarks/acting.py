"""A step of acting: the backbone with cached tokens, compared with encoding the whole window.

Windows advance by one observation per step, as in an environment; every 25 steps, one environment
begins a new episode. Ours is the ``Backbone`` in acting mode, including its comparison of frames,
both eager and with its two parts compiled. The peer is the straightforward network on the same
windows. Times are milliseconds per step, in processor time of one thread.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_tit.modules import Backbone

from .measuring import ratios, take_turns
from .straightforward import Case

ROUNDS, SECONDS, STEPS = 7, 0.5, 100
CASES = [
    Case(variant, inputs, num_frames, 8)
    for inputs in ("arrays", "images")
    for variant in ("Enhanced", "Vanilla")
    for num_frames in (1, 4, 16, 64)
]


def is_compiled(case: Case) -> bool:
    """Whether a case is also measured compiled, which takes a minute each."""
    sizes = (4, 16, 64) if case.variant == "Enhanced" else (4, 64)
    return case.inputs == "images" and case.num_frames in sizes


def make_windows(case: Case, steps: int) -> list[Tensor]:
    """Makes the windows of consecutive steps, [batch, K, *observation_shape] each."""
    frames = case.frames(steps + case.num_frames - 1)
    windows = [frames[:, step : step + case.num_frames].clone() for step in range(steps)]
    for start in range(10, steps, 25):  # an episode begins: the first frame is repeated
        for step in range(start, min(steps, start + case.num_frames)):
            windows[step][0, : case.num_frames - 1 - (step - start)] = frames[
                0, start + case.num_frames - 1
            ]
    return windows


@torch.no_grad()
def measure(case: Case, rounds: int, seconds: float, *, compiled: bool) -> dict[str, Any]:
    """Measures ours, ours compiled and the straightforward network."""
    torch.manual_seed(0)
    with ExitStack() as stack:

        def act(network: Callable[[Tensor], Any]) -> Callable[[], None]:
            windows = itertools.cycle(make_windows(case, STEPS))
            return lambda: network(next(windows))

        def ours(compiled: bool) -> Callable[[], None]:
            backbone = Backbone(case.ours()).eval()
            if compiled:
                backbone.compile_parts(dynamic=False)
            stack.enter_context(backbone.acting())
            return act(lambda window: backbone(TensorDict({"history": window}, [len(window)])))

        steps = {"ours": ours(False)}
        if compiled:
            steps["compiled"] = ours(True)
        steps["straightforward"] = act(case.straightforward().eval())
        times = take_turns(steps, rounds, seconds)
    row: dict[str, Any] = {**case.record(), **{f"{name}_ms": x for name, x in times.items()}}
    for name in ("ours", "compiled"):
        if name in times:
            row[f"{name}_ratios"] = ratios(times["straightforward"], times[name])
    return row


def main() -> dict[str, Any]:
    """Measures all cases."""
    return {"rows": [measure(case, ROUNDS, SECONDS, compiled=is_compiled(case)) for case in CASES]}
