"""A step of acting and a training step of each memory, by the length of what it remembers.

The networks are those of the memory recipes on arrays of 4. Acting: 16 environments, one step,
eager; networks that read K = T frames keep the tokens of earlier ones. Training: forward, backward
and Adam on 4,096 steps in sequences of T, in each of which an episode begins after a third;
networks that read K = T frames see up to T steps back. One thread, processor time, alternating.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from recipes.presets.ppo_memory import memory_networks
from torchrl_tit.modules import Backbone
from torchrl_tit.networks import build_network

from .measuring import take_turns
from .segments import make_descent

SAMPLES, COPIES, WIDTH, ROUNDS, SECONDS = 4096, 16, 4, 3, 1.0
LENGTHS = [64, 512, 4096]
NAMES = [name for name in memory_networks(2) if name != "frames-4"]


def make_backbone(name: str, length: int) -> Backbone:
    """Builds a memory that reaches back over ``length`` steps."""
    return Backbone(build_network(memory_networks(length)[name], (WIDTH,)), padding="same")


def make_sequences(backbone: Backbone, length: int, samples: int = SAMPLES) -> TensorDictBase:
    """Random sequences [N, length]; each begins an episode, and another one after a third."""
    count, num_frames = samples // length, backbone.module.num_frames
    observation = torch.randn(count, length, WIDTH)
    is_init = torch.zeros(count, length, 1, dtype=torch.bool)
    is_init[:, [0, length // 3]] = True
    history = observation.unsqueeze(2)
    if not backbone.is_recurrent:  # it is read at the first step only
        history = history[:, :1].expand(-1, length, num_frames, -1)
    states = {key: torch.zeros(count, length, *x) for key, x in backbone.state_shapes.items()}
    entries = {"observation": observation, "history": history, "is_init": is_init, **states}
    return TensorDict(entries, [count, length])


def training(backbone: Backbone, length: int) -> Callable[[], None]:
    """Returns a training step on sequences."""

    def loss_of(sequences: TensorDictBase) -> Tensor:
        with set_recurrent_mode(True):
            return backbone(sequences.copy())["features"].square().mean()

    return make_descent(backbone, loss_of, make_sequences(backbone, length))


def acting(backbone: Backbone, length: int, stack: ExitStack) -> Callable[[], None]:
    """Returns a step of acting, in the acting mode that the stack leaves."""
    backbone.eval()
    frames = torch.randn(COPIES, length + 100, WIDTH)
    starts = itertools.cycle(range(100))
    num_frames = backbone.module.num_frames
    carried = {key: torch.zeros(COPIES, *size) for key, size in backbone.state_shapes.items()}
    carried |= {"is_init": torch.zeros(COPIES, 1, dtype=torch.bool)} if carried else {}
    stack.enter_context(backbone.acting())

    @torch.no_grad()
    def step() -> None:
        start = next(starts)
        window = frames[:, start : start + num_frames]
        after = backbone(TensorDict({"history": window, **carried}, [COPIES]))
        carried.update({key: after["next", key] for key in backbone.state_shapes})

    return step


def main(
    lengths: Sequence[int] = LENGTHS, names: Sequence[str] = NAMES, seconds: float = SECONDS
) -> dict[str, Any]:
    """Measures, alternating between the memories."""
    rows: dict[str, dict[str, Any]] = {name: {} for name in names}
    for length in lengths:
        torch.manual_seed(0)
        times = measure(partial(make_backbone, length=length), names, length, seconds)
        for what, found in times.items():
            for name, milliseconds in found.items():
                rows[name][f"{what}_{length}_ms"] = milliseconds
    return rows


def measure(
    make: Callable[[str], Backbone], names: Sequence[str], length: int, seconds: float
) -> dict[str, dict[str, list[float]]]:
    """The milliseconds of a step of acting and of a training step of each backbone."""
    with ExitStack() as stack:
        acts = {name: acting(make(name), length, stack) for name in names}
        acted = take_turns(acts, ROUNDS, seconds)
    trained = take_turns({n: training(make(n), length) for n in names}, ROUNDS, seconds)
    return {"acting": acted, "training": trained}
