"""Exported policies: the size of the files, and steps per second of each form and format.

The live policy is the TensorDict policy in acting mode, which keeps tokens too. Every policy acts
on the same frames, which advance by one per step, in one environment or several side by side. Times
are the processor time of one thread, which other programs on the machine hardly affect.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
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

from .measuring import take_turns
from .straightforward import Case

STEPS, ROUNDS = 30, 5
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


@torch.no_grad()
def measure(case: Case, steps: int, rounds: int) -> dict[str, Any]:
    """Exports the policy of a case in every way; measures sizes, and steps per second, alternating.

    Returns:
        For each form, "kB" (None for the live policy) and, for each number of environments, the
        total steps per second of each round.
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
    with tempfile.TemporaryDirectory() as folder, acting(policy):
        for suffix in FORMATS:
            for step_by_step in (False, True)[:num_frames]:
                name = f"{suffix}{', step by step' if step_by_step else ''}"
                file = Path(folder, f"{len(acts)}.{suffix}")
                facts = export_policy(policy, task, file, step_by_step=step_by_step)
                kilobytes[name] = file.stat().st_size // 1000
                acts[name] = exported(file, facts, num_frames)
        rates: dict[str, dict[int, list[float]]] = {name: {} for name in acts}
        for size in SIZES:
            frames = case.frames(steps + num_frames)[:size]
            plays = {name: partial(play, act, frames, num_frames) for name, act in acts.items()}
            for name, times in take_turns(plays, rounds, 0).items():
                rates[name][size] = [1000 * size * (steps + 1) / one for one in times]
    return {name: {"kB": kilobytes[name], "rates": rates[name]} for name in acts}


def play(act: Act, frames: Tensor, num_frames: int) -> list[Tensor]:
    """Acts on frames that advance by one; returns the actions."""
    ends = range(num_frames, frames.shape[1] + 1)
    return [act(frames[:, :end], end == num_frames) for end in ends]


def main() -> dict[str, Any]:
    """Measures all cases."""
    return {"rows": [{**case.record(), "forms": measure(case, STEPS, ROUNDS)} for case in CASES]}
