"""PPO on CartPole end to end: our recipe against Stable-Baselines3 with the same network.

Both: Enhanced_TIT with K 1, width 32, 2 blocks, 1 head, features 64; 8 environments, 2048 steps a
batch, minibatches of 64, 10 epochs, one thread. Environment steps a second over whole batches,
collecting and updating; the first batch, in which libraries warm up and compile, is left out.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss

from recipes import ppo
from recipes.compilation import Compile
from recipes.metrics import read_metrics
from recipes.registry import get_recipe
from recipes.run import Run
from torchrl_tit.envs import GymVectorEnv
from torchrl_tit.modules import Backbone

from .report import publish, spread, table
from .straightforward import StraightforwardTIT

BATCHES, STEPS, ENVS, REPEATS = 4, 2048, 8, 5


class Extractor(BaseFeaturesExtractor):
    """The straightforward network in Stable-Baselines3's terms: observations without history."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, 64)
        self.network = StraightforwardTIT(space.shape)

    def forward(self, observation: Tensor) -> Tensor:
        return self.network(observation.unsqueeze(1))


class Clock(BaseCallback):
    """Notes when each rollout begins."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def _on_rollout_start(self) -> None:
        self.times.append(time.perf_counter())

    def _on_step(self) -> bool:
        return True


def run_sb3(seed: int) -> tuple[float, int]:
    """Steps a second, and the number of parameters."""
    env = make_vec_env("CartPole-v1", ENVS, seed=seed)
    agent = PPO(
        "MlpPolicy",
        env,
        n_steps=STEPS // ENVS,
        batch_size=64,
        n_epochs=10,
        seed=seed,
        device="cpu",
        policy_kwargs={"features_extractor_class": Extractor, "net_arch": []},
    )
    clock = Clock()
    agent.learn(BATCHES * STEPS, callback=clock)
    clock.times.append(time.perf_counter())
    parameters = sum(parameter.numel() for parameter in agent.policy.parameters())
    return (BATCHES - 1) * STEPS / (clock.times[-1] - clock.times[1]), parameters


def run_ours(seed: int, compile: Compile = "off") -> tuple[float, int, float]:
    """Steps a second, the number of parameters, and how long the first batch took, in seconds."""
    named = get_recipe("ppo/cartpole/enhanced-tit")
    assert isinstance(named, ppo.PPO)
    recipe = replace(named, num_envs=ENVS, total_steps=BATCHES * STEPS, seed=seed, compile=compile)
    with tempfile.TemporaryDirectory() as folder, Run.create(Path(folder, "run"), recipe) as run:
        start = time.time()
        recipe.train(run)
        times = [row["time"] for row in read_metrics(run.folder / "metrics.csv")]
    agent = ppo.Agent(recipe, recipe.make_env(1, seed))
    parameters = sum(parameter.numel() for parameter in agent.parameters())
    return (BATCHES - 1) * STEPS / (times[-1] - times[0]), parameters, times[0] - start


@contextmanager
def timed(*parts: tuple[str, Any, str]) -> Iterator[dict[str, float]]:
    """Adds up the seconds that pass in functions: (name of the part, owner, function)."""
    seconds: dict[str, float] = defaultdict(float)
    originals = [(owner, function, getattr(owner, function)) for _, owner, function in parts]

    def wrap(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def timing(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                key = name
                if name == "backbone":  # acting has its own row
                    key = "update: backbone" if torch.is_grad_enabled() else "collect: backbone"
                seconds[key] += time.perf_counter() - start

        return timing

    for (name, owner, function), (_, _, original) in zip(parts, originals, strict=True):
        setattr(owner, function, wrap(name, original))
    try:
        yield seconds
    finally:
        for owner, function, original in originals:
            setattr(owner, function, original)


def profile() -> dict[str, float]:
    """Seconds of each part of our run."""
    with timed(
        ("collect: all", Collector, "rollout"),
        ("collect: environments", GymVectorEnv, "step_and_maybe_reset"),
        ("backbone", Backbone, "forward"),
        ("advantages", ppo, "add_advantages"),
        ("update: heads and loss", ClipPPOLoss, "forward"),
        ("update: backward", torch.Tensor, "backward"),
        ("update: gradient norm", nn.utils, "clip_grad_norm_"),
        ("update: optimizer", torch.optim.Adam, "step"),
    ) as seconds:
        start = time.perf_counter()
        run_ours(0)
        seconds["all"] = time.perf_counter() - start
    return dict(seconds)


def main(out: Path | None) -> None:
    """Measures on one thread."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as cache:  # what was compiled before must not help
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
        measure(out)


def measure(out: Path | None) -> None:
    """Measures, alternating, and reports."""
    sb3, ours, compiled, compile_seconds = [], [], [], []
    for repeat in range(REPEATS):
        speed, sb3_parameters = run_sb3(repeat)
        sb3.append(speed)
        speed, our_parameters, _ = run_ours(repeat)
        ours.append(speed)
        speed, _, first_batch = run_ours(repeat, "on")
        compiled.append(speed)
        compile_seconds.append(first_batch - STEPS / speed)
    assert sb3_parameters == our_parameters, (sb3_parameters, our_parameters)
    ratios = [a / b for a, b in zip(ours, sb3, strict=True)]
    compiled_ratios = [a / b for a, b in zip(compiled, sb3, strict=True)]
    seconds = profile()
    whole = seconds["all"]
    markdown = (
        "# PPO on CartPole-v1, end to end\n\n"
        f"Enhanced_TIT (K 1, width 32, 2 blocks, 1 head, features 64; {our_parameters} parameters "
        f"with the heads), {ENVS} environments, {STEPS} steps a batch, minibatches of 64, 10 "
        f"epochs, one thread. {REPEATS} rounds of runs, alternating, of {BATCHES - 1} batches.\n\n"
        + table(
            ["", "environment steps a second: median (range)", "ratio, pair by pair"],
            [
                ["Stable-Baselines3, straightforward network", spread(sb3), ""],
                ["this library", spread(ours), spread(ratios, 2)],
                ["this library, `--compile on`", spread(compiled), spread(compiled_ratios, 2)],
            ],
        )
        + f"\nCompiling took {compile_seconds[0]:.0f} seconds the first time, in the batch that is "
        "left out, with nothing\ncached on the disk. It is on by default in runs of 10,000 "
        "gradient steps or more (this recipe's 100k\nsteps have 15,680), where there is a C++ "
        "compiler.\n"
        "\nWhere our time goes (a run of its own, with the timers in it):\n\n"
        + table(
            ["part", "share"],
            [[name, f"{100 * seconds[name] / whole:.0f} %"] for name in sorted(seconds)],
        )
    )
    numbers = {
        "sb3_steps_per_second": sb3,
        "our_steps_per_second": ours,
        "ratios": ratios,
        "median_ratio": statistics.median(ratios),
        "our_compiled_steps_per_second": compiled,
        "compiled_ratios": compiled_ratios,
        "compile_seconds": compile_seconds,
        "median_compiled_ratio": statistics.median(compiled_ratios),
        "seconds_of_parts": seconds,
    }
    publish("ppo_cartpole", markdown, numbers, out)
