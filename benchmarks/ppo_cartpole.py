"""PPO on CartPole end to end: our recipe compared with Stable-Baselines3 on the same network.

Both: Enhanced_TIT with K = 1 or 8, width 32, 2 blocks, 1 head and 64 features; 8 environments, 2048
steps per batch, minibatches of 64, 10 epochs, one thread. With K = 8, theirs reads stacked frames,
and ours trains on sequences. Speed is environment steps per second over whole batches, collection
and update together, without the first batch, in which libraries warm up and compile.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector

from recipes import ppo, runner
from recipes.algorithm import make_algorithm
from recipes.callback import Callback
from recipes.metrics import read_metrics
from recipes.ppo import PPOAlgorithm, algorithm
from recipes.recipe import Compile
from recipes.registry import get_recipe
from recipes.results.plot import save_figure
from recipes.run import Run
from torchrl_tit.envs import TransformedVectorEnv
from torchrl_tit.modules import Backbone

from .report import publish, spread, table
from .straightforward import StraightforwardTIT

STEPS, ENVS = 2048, 8


@dataclass(frozen=True)
class Setting:
    """A number of frames, and for how long and how often it is measured."""

    num_frames: int
    batches: int
    repeats: int


SETTINGS = [
    Setting(num_frames=1, batches=5, repeats=5),
    Setting(num_frames=8, batches=3, repeats=3),
]


@dataclass
class Outcome:
    """Speed and return of a run."""

    laps: list[tuple[float, float]]
    """Wall time and processor time at the end of each batch, in seconds."""
    first_batch: float
    """Wall time of the first batch, in seconds."""
    training_return: float
    """Mean return of the episodes that ended in the last batch."""
    parameters: int

    def speed(self, clock: int = 0) -> float:
        """Environment steps per second of wall time (0) or processor time (1)."""
        seconds = self.laps[-1][clock] - self.laps[0][clock]
        return (len(self.laps) - 1) * STEPS / seconds


def lap() -> tuple[float, float]:
    """Wall time and processor time now, in seconds."""
    return time.perf_counter(), time.process_time()


class Extractor(BaseFeaturesExtractor):
    """The straightforward network for Stable-Baselines3, whose frames are stacked in one array."""

    def __init__(self, space: Any, num_frames: int) -> None:
        super().__init__(space, 64)
        self.num_frames = num_frames
        self.network = StraightforwardTIT((space.shape[0] // num_frames,))

    def forward(self, observation: Tensor) -> Tensor:
        return self.network(observation.unflatten(1, (self.num_frames, -1)))


class Batches(BaseCallback):
    """Records when each batch and its update end, and the returns of the last batch."""

    def __init__(self) -> None:
        super().__init__()
        self.laps: list[tuple[float, float]] = []
        self.returns: list[float] = []

    def _on_rollout_start(self) -> None:
        if self.num_timesteps:
            self.laps.append(lap())
        self.returns.clear()

    def _on_step(self) -> bool:
        self.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_training_end(self) -> None:
        self.laps.append(lap())


def run_sb3(setting: Setting, seed: int) -> Outcome:
    """Trains Stable-Baselines3 with the straightforward network."""
    env = make_vec_env("CartPole-v1", ENVS, seed=seed)
    agent = PPO(
        "MlpPolicy",
        VecFrameStack(env, setting.num_frames) if setting.num_frames > 1 else env,
        n_steps=STEPS // ENVS,
        batch_size=64,
        n_epochs=10,
        seed=seed,
        device="cpu",
        policy_kwargs={
            "features_extractor_class": Extractor,
            "features_extractor_kwargs": {"num_frames": setting.num_frames},
            "net_arch": [],
        },
    )
    batches = Batches()
    start, _ = lap()
    agent.learn(setting.batches * STEPS, callback=batches)
    parameters = sum(parameter.numel() for parameter in agent.policy.parameters())
    first = batches.laps[0][0] - start
    return Outcome(batches.laps, first, statistics.mean(batches.returns), parameters)


def run_ours(
    setting: Setting, seed: int, compile: Compile, timers: Timers | None = None
) -> Outcome:
    """Trains the recipe as the command line does, with checkpoints and metrics."""
    named = get_recipe("ppo/cartpole/enhanced-tit-protocol")
    assert isinstance(named, ppo.PPO)
    recipe = replace(
        named,
        backbone=replace(named.backbone, num_frames=setting.num_frames),
        num_envs=ENVS,
        steps_per_batch=STEPS,
        total_steps=setting.batches * STEPS,
        seed=seed,
        compile=compile,
    )
    laps = Laps(timers)
    with tempfile.TemporaryDirectory() as folder, Run.create(Path(folder, "run"), recipe) as run:
        start, _ = lap()
        runner.train(recipe, run, [laps])
        last = read_metrics(run.folder / "metrics.csv")[-1]
    networks = make_algorithm(recipe).model
    assert isinstance(networks, nn.Module)
    parameters = sum(parameter.numel() for parameter in networks.parameters())
    return Outcome(laps.laps, laps.laps[0][0] - start, last["return_mean"], parameters)


class Laps(Callback):
    """Records when each update ends; timers start after the first one."""

    def __init__(self, timers: Timers | None) -> None:
        self.laps: list[tuple[float, float]] = []
        self.timers = timers

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        self.laps.append(lap())
        if self.timers is not None and len(self.laps) == 1:
            self.timers.seconds.clear()
        return False


class Timers:
    """Adds up the seconds that pass in functions."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def around(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                # The backbone runs in both; only the update has gradients.
                key = part.format("update" if torch.is_grad_enabled() else "collect")
                self.seconds[key] += time.perf_counter() - start

        return timed


def profile(setting: Setting, compile: Compile) -> dict[str, float]:
    """Measures the share of each part in our time, without the first batch."""
    timers = Timers()
    prepare = PPOAlgorithm.prepare

    def prepare_timed(self: PPOAlgorithm, *args: Any) -> None:
        prepare(self, *args)
        self.objective = timers.around(self.objective, "update: forward")

    parts: list[tuple[Any, str, str]] = [
        (Collector, "rollout", "collect"),
        (TransformedVectorEnv, "step_and_maybe_reset", "collect: environments"),
        (algorithm, "add_advantages", "advantages"),
        (Tensor, "backward", "update: backward"),
        (nn.utils, "clip_grad_norm_", "update: gradient norm"),
        (torch.optim.Adam, "step", "update: optimizer"),
    ]
    if compile == "off":  # parts of compiled code cannot be timed
        parts.append((Backbone, "forward", "{}: backbone"))
    with ExitStack() as stack:
        for owner, name, part in parts:
            function = timers.around(getattr(owner, name), part)
            stack.enter_context(patch.object(owner, name, function))
        stack.enter_context(patch.object(PPOAlgorithm, "prepare", prepare_timed))
        laps = run_ours(setting, 0, compile, timers).laps
    seconds = dict(timers.seconds)
    acting = seconds.get("collect: backbone", 0)
    encoding = seconds.get("update: backbone", 0)
    seconds["collect: the rest"] = (
        seconds.pop("collect") - seconds["collect: environments"] - acting
    )
    seconds["update: heads and loss"] = seconds.pop("update: forward") - encoding
    whole = laps[-1][0] - laps[0][0]
    seconds["minibatches, checks, metrics, checkpoints"] = whole - sum(seconds.values())
    return {part: passed / whole for part, passed in sorted(seconds.items())}


def draw(shares: dict[str, dict[str, float]], picture: Path) -> None:
    """Draws each part's share of the time of a PPO step, one bar for each mode."""
    figure = Figure(figsize=(8, 3.2), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    names = {"compiled": "compiled", "ours": "--compile off"}
    parts = sorted({part for share in shares.values() for part in share})
    start = [0.0] * len(names)
    for index, part in enumerate(parts):
        widths = [100 * shares[name].get(part, 0) for name in names]
        axes.barh(list(names.values()), widths, left=start, color=f"C{index}", label=part)
        start = [left + width for left, width in zip(start, widths, strict=True)]
    axes.set(xlabel="% of the time of a PPO step", xlim=(0, 100))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3, frameon=False)
    save_figure(figure, picture)


def main(out: Path | None) -> None:
    """Measures on one thread, with an empty compile cache."""
    torch.set_num_threads(1)
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, TORCHINDUCTOR_CACHE_DIR=cache),
    ):
        measure(out)


def measure(out: Path | None) -> None:
    """Measures, alternating, and reports."""
    sections, numbers = [], {}
    for setting in SETTINGS:
        runs = take_turns(setting)
        sections.append(section(setting, runs))
        numbers[f"K = {setting.num_frames}"] = {
            name: {
                "steps_per_second": [outcome.speed() for outcome in outcomes],
                "steps_per_second_of_processor_time": [outcome.speed(1) for outcome in outcomes],
                "training_return": [outcome.training_return for outcome in outcomes],
                "first_batch_seconds": [outcome.first_batch for outcome in outcomes],
            }
            for name, outcomes in runs.items()
        }
    shares = {name: profile(SETTINGS[0], mode) for name, mode in MODES.items()}
    markdown = (
        "# PPO on CartPole-v1, end to end\n\n"
        f"Enhanced_TIT (width 32, 2 blocks, 1 head, features 64), {ENVS} environments, {STEPS} "
        "steps a batch,\nminibatches of 64, 10 epochs, one thread. Runs alternate, and the first "
        "batch of each is left out. Medians\nand ranges; ratios are taken round by round. The "
        "return is that of the episodes that ended in the last\nbatch.\n\n"
        + "\n".join(sections)
        + "\nCompiling is on by default in runs of 10,000 gradient steps or more (100k steps have "
        "15,680), where there\nis a C++ compiler.\n\nWhere our time goes with K = 1 (separate "
        "runs, with timers):\n\n"
        + table(
            ["part", "compiled", "`--compile off`"],
            [
                [
                    part,
                    *(f"{100 * share[part]:.0f} %" if part in share else "" for share in columns),
                ]
                for columns in [(shares["compiled"], shares["ours"])]
                for part in shares["ours"]
            ],
        )
        + "\nIn compiled runs, the backbone is part of *the rest* and of *heads and loss*.\n"
    )
    publish("ppo_cartpole", markdown, {**numbers, "shares": shares}, out)
    if out is not None:
        draw(shares, out / "ppo_cartpole.png")


MODES: dict[str, Compile] = {"ours": "off", "compiled": "on"}


def take_turns(setting: Setting) -> dict[str, list[Outcome]]:
    """Runs both libraries in turns."""
    runs: dict[str, list[Outcome]] = defaultdict(list)
    for repeat in range(setting.repeats):
        runs["sb3"].append(run_sb3(setting, repeat))
        for name, mode in MODES.items():
            runs[name].append(run_ours(setting, repeat, mode))
    return runs


def section(setting: Setting, runs: dict[str, list[Outcome]]) -> str:
    """Makes the table for a number of frames."""
    (parameters,) = {outcome.parameters for outcomes in runs.values() for outcome in outcomes}
    return (
        f"K = {setting.num_frames}: {parameters} parameters with the heads, {setting.repeats} "
        f"rounds of {setting.batches} batches; compiling took "
        f"{runs['compiled'][0].first_batch:.0f} seconds\nthe first time, with nothing cached, in "
        "the first batch.\n\n"
        + table(
            ["", "steps a second", "ratio", "ratio of processor time", "return after training"],
            [
                row("Stable-Baselines3, straightforward network", runs["sb3"], runs["sb3"]),
                row("this library, compiled", runs["compiled"], runs["sb3"]),
                row("this library, `--compile off`", runs["ours"], runs["sb3"]),
            ],
        )
    )


def row(name: str, runs: list[Outcome], peers: list[Outcome]) -> list[str]:
    """Makes a row of the table: speed, its ratios to a peer's, and the return."""
    ratios = (
        [run.speed(clock) / peer.speed(clock) for run, peer in zip(runs, peers, strict=True)]
        for clock in (0, 1)
    )
    return [
        name,
        spread([run.speed() for run in runs]),
        *("" if runs is peers else spread(ratio, 2) for ratio in ratios),
        spread([run.training_return for run in runs]),
    ]
