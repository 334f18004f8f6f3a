"""Exported policies: the size of the files, and steps per second of each form and format.

The live policy is the TensorDict policy in acting mode, which keeps tokens too. Every policy acts
on the same frames, which advance by one per step, in one environment or several side by side. Times
are the processor time of one thread, which other programs on the machine hardly affect.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torchrl_tit.envs import make_env
from torchrl_tit.export import export_policy
from torchrl_tit.export.formats import FORMATS
from torchrl_tit.modules import Backbone, acting, make_actor

from .cases import Case
from .report import publish, spread, table

STEPS, REPEATS = 30, 5
SIZES = (1, 8)
CASES = [
    Case("Enhanced", "arrays", 4, max(SIZES)),
    Case("Enhanced", "images", 4, max(SIZES)),
    Case("Enhanced", "images", 16, max(SIZES)),
]
_TASKS = {"arrays": "CartPole-v1", "images": "ALE/Pong-v5"}

Act = Callable[[Tensor, bool], Tensor]
"""Acts on the frames so far [N, T, *obs], given whether they are the first of an episode."""


def live(policy: TensorDictSequential, num_frames: int) -> Act:
    """The TensorDict policy."""

    def act(frames: Tensor, first: bool) -> Tensor:
        window = frames[:, -num_frames:]
        return policy(TensorDict({"history": window}, [len(frames)]))["action"]

    return act


def exported(file: Path, facts: dict[str, Any], num_frames: int) -> Act:
    """A file."""
    run = FORMATS[file.suffix.removeprefix(".")].read(file)
    kept: dict[str, Tensor] = {}

    def act(frames: Tensor, first: bool) -> Tensor:
        if "history" in facts["inputs"]:
            return run({"history": frames[:, -num_frames:].contiguous()})["action"]
        inputs = {"observation": frames[:, -1].contiguous()}
        if facts["state"]:
            shape = facts["inputs"]["tokens"]["shape"]
            tokens = torch.zeros(len(frames), *shape) if first else kept["tokens"]
            inputs |= {"tokens": tokens, "is_init": torch.full((len(frames),), first)}
        outputs = run(inputs)
        kept["tokens"] = outputs.get("next_tokens", torch.empty(0))
        return outputs["action"]

    return act


def seconds(act: Act, frames: Tensor, num_frames: int) -> float:
    """The seconds that a step takes."""
    count = frames.shape[1] - num_frames + 1
    act(frames[:, :num_frames], True)
    start = time.thread_time()
    for step in range(1, count):
        act(frames[:, : num_frames + step], False)
    return (time.thread_time() - start) / (count - 1)


@torch.no_grad()
def measure(case: Case, steps: int, repeats: int) -> dict[str, Any]:
    """Exports the policy of a case in every way; measures sizes, and steps per second, alternating.

    Returns:
        For each form, "kB" (None for the live policy) and, for each number of environments, the
        total steps per second of each repeat.
    """
    torch.manual_seed(0)
    num_frames = case.num_frames
    task = partial(make_env, _TASKS[case.inputs], num_frames=num_frames)
    env = task(1)
    network = case.ours()
    actor = make_actor(network.features_dim, env.action_spec_unbatched)
    env.close()
    policy = TensorDictSequential(Backbone(network), actor).eval()
    acts: dict[str, Act] = {"live": live(policy, num_frames)}
    kilobytes: dict[str, int | None] = {"live": None}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        stack.enter_context(acting(policy))
        for suffix in FORMATS:
            for step_by_step in (False, True)[:num_frames]:
                name = f"{suffix}{', step by step' if step_by_step else ''}"
                file = Path(folder, f"{len(acts)}.{suffix}")
                facts = export_policy(policy, task, file, step_by_step=step_by_step)
                kilobytes[name] = file.stat().st_size // 1000
                acts[name] = exported(file, facts, num_frames)
        rates: dict[str, dict[int, list[float]]] = {name: {n: [] for n in SIZES} for name in acts}
        for _ in range(repeats):
            frames = case.frames(steps + num_frames)
            for size in SIZES:
                for name, act in acts.items():
                    rates[name][size].append(size / seconds(act, frames[:size], num_frames))
    return {name: {"kB": kilobytes[name], "rates": rates[name]} for name in acts}


def main(out: Path | None) -> None:
    """Measures on one thread and reports."""
    torch.set_num_threads(1)
    measured = [measure(case, STEPS, REPEATS) for case in CASES]
    rows = [
        [
            case.inputs,
            case.num_frames,
            name,
            "" if found["kB"] is None else found["kB"],
            *(spread(found["rates"][size]) for size in SIZES),
            f"{_median(found, 1) / _median(row['live'], 1):.1f}",
        ]
        for case, row in zip(CASES, measured, strict=True)
        for name, found in row.items()
    ]
    environments = [f"steps/s, {n} env{'s' * (n > 1)}" for n in SIZES]
    markdown = (
        "# Exported policies\n\nEnhanced_TIT with the paper's sizes. Steps a second of all "
        f"environments together: median (range) of {REPEATS} rounds of {STEPS} steps, "
        "alternating, by the\nprocessor time of one thread. The last column is the ratio of "
        "the medians for one environment.\n\n"
        + table(["inputs", "K", "form", "kB", *environments, "times live"], rows)
    )
    numbers = [{**case.record(), "forms": row} for case, row in zip(CASES, measured, strict=True)]
    publish("export", markdown, {"rows": numbers}, out)


def _median(found: dict[str, Any], size: int) -> float:
    return statistics.median(found["rates"][size])
