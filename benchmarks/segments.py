"""A training step on segments, which encode each frame once, compared with full windows.

64 samples, forward, backward and fused Adam, one thread, processor time, eager and compiled. Ours
reads segments of consecutive steps in TorchRL's recurrent mode: one of 64, or four of 16, which is
the default of the PPO recipes. The straightforward network reads 64 full windows of K frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from torchrl_tit import Backbone

from .measuring import empty_compile_cache, take_turns
from .straightforward import Case

SAMPLES, ROUNDS, SECONDS = 64, 5, 0.5


@dataclass(frozen=True)
class Row:
    """A network on segments of one length."""

    case: Case
    length: int
    compiled: bool = False


def _row(variant: Any, inputs: Any, num_frames: int, length: int, compiled: bool = False) -> Row:
    return Row(Case(variant, inputs, num_frames, SAMPLES), length, compiled)


ROWS = [
    *(_row("Enhanced", "images", k, 64, compiled=True) for k in (4, 16, 64)),
    *(_row("Enhanced", "images", k, 16) for k in (4, 16, 64)),
    *(_row("Vanilla", "images", k, 64) for k in (4, 16, 64)),
    *(_row("Enhanced", "arrays", k, 64, compiled=True) for k in (16, 64)),
    *(_row("Enhanced", "arrays", k, 16) for k in (16, 64)),
]


def make_descent(
    network: nn.Module, loss_of: Callable[[Any], Tensor], inputs: Any, compiled: bool = False
) -> Callable[[], None]:
    """Returns a function that takes one Adam step on a loss of its inputs."""
    optimizer = torch.optim.Adam(network.parameters(), fused=True)
    loss = torch.compile(loss_of, dynamic=False) if compiled else loss_of

    def step() -> None:
        optimizer.zero_grad()
        loss(inputs).backward()
        optimizer.step()

    return step


def make_segments(case: Case, length: int) -> TensorDictBase:
    """Random segments [N, length]; the history is the window at the start of each."""
    count = case.batch // length
    frames = Case(case.variant, case.inputs, case.num_frames, count).frames(
        case.num_frames - 1 + length
    )
    start = frames[:, : case.num_frames].unsqueeze(1)
    return TensorDict(
        {
            "history": start.expand(-1, length, *start.shape[2:]),
            "observation": frames[:, case.num_frames - 1 :],
            "is_init": torch.zeros(count, length, 1, dtype=torch.bool),
        },
        [count, length],
    )


def on_segments(case: Case, length: int, compiled: bool) -> Callable[[], None]:
    """Returns a training step on segments."""
    network = case.ours()
    backbone = Backbone(network, padding="same")

    def loss_of(segments: TensorDictBase) -> Tensor:
        with set_recurrent_mode(True):
            return backbone(segments.copy())["features"].square().mean()

    return make_descent(network, loss_of, make_segments(case, length), compiled)


def on_windows(case: Case) -> Callable[[], None]:
    """Returns a training step of the straightforward network on full windows."""
    network, windows = case.straightforward(), case.frames(case.num_frames)
    return make_descent(network, lambda x: network(x).square().mean(), windows)


def measure(row: Row, rounds: int, seconds: float) -> dict[str, Any]:
    """Measures the milliseconds of each program in each round, alternating."""
    torch.manual_seed(0)
    case = row.case
    steps = {
        "segments": on_segments(case, row.length, False),
        "straightforward": on_windows(case),
    }
    if row.compiled:
        steps["segments, compiled"] = on_segments(case, row.length, True)
    times = take_turns(steps, rounds, seconds)
    return {**case.record(), "length": row.length, "ms": times}


def main() -> dict[str, Any]:
    """Measures with an empty compile cache."""
    with empty_compile_cache():
        return {"rows": [measure(row, ROUNDS, SECONDS) for row in ROWS]}
