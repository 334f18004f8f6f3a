"""PPO on CartPole end to end: our recipe compared with Stable-Baselines3 on the same network.

Both: Enhanced_TIT with K = 1 or 8, width 32, 2 blocks, 1 head and 64 features; 8 environments, 2048
steps per batch, minibatches of 64, 10 epochs, one thread. With K = 8, theirs reads stacked frames,
and ours trains on sequences. Speed is environment steps per second over whole batches, collection
and update together, without the first batch, in which libraries warm up and compile.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field, replace
from math import nan
from pathlib import Path
from statistics import fmean
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from recipes import ppo
from recipes.core import runner
from recipes.core.callback import Callback
from recipes.core.metrics import read_metrics
from recipes.core.recipe import Compile
from recipes.core.registry import get_recipe
from recipes.core.run import Run

from .measuring import empty_compile_cache
from .straightforward import StraightforwardTIT

STEPS, ENVS = 2048, 8
SETTINGS = {1: (5, 5), 8: (3, 3)}
"""How many batches a run has, and how many rounds there are, by the number of frames."""
MODES: dict[str, Compile] = {"compiled": "on", "ours": "off"}


@dataclass
class Laps:
    """Wall time and processor time at the end of each batch, in seconds."""

    steps: int
    """Environment steps of a batch."""
    start: float = field(default_factory=time.perf_counter)
    ends: list[tuple[float, float]] = field(default_factory=list)
    training_return: float = float("nan")
    """Mean return of the episodes that ended in the last batch."""

    def add(self) -> None:
        self.ends.append((time.perf_counter(), time.process_time()))

    def speed(self, clock: int = 0) -> float:
        """Environment steps per second of wall time (0) or processor time (1)."""
        return (len(self.ends) - 1) * self.steps / (self.ends[-1][clock] - self.ends[0][clock])


class Extractor(BaseFeaturesExtractor):
    """The straightforward network for Stable-Baselines3, whose frames are stacked in one array."""

    def __init__(self, space: Any, num_frames: int) -> None:
        super().__init__(space, 64)
        self.num_frames = num_frames
        self.network = StraightforwardTIT((space.shape[0] // num_frames,))

    def forward(self, observation: Tensor) -> Tensor:
        return self.network(observation.unflatten(1, (self.num_frames, -1)))


class TheirLaps(BaseCallback):
    """Records when each batch and its update end, and the returns of the last batch."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.laps = Laps(steps)
        self.returns: list[float] = []

    def _on_rollout_start(self) -> None:
        if self.num_timesteps:
            self.laps.add()
        self.returns.clear()

    def _on_step(self) -> bool:
        self.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_training_end(self) -> None:
        self.laps.add()
        self.laps.training_return = fmean(self.returns or [nan])


class OurLaps(Callback):
    """Records when each update ends."""

    def __init__(self, steps: int) -> None:
        self.laps = Laps(steps)

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        self.laps.add()
        return False


def run_sb3(num_frames: int, batches: int, seed: int) -> Laps:
    """Trains Stable-Baselines3 with the straightforward network."""
    env = make_vec_env("CartPole-v1", ENVS, seed=seed)
    network = {
        "features_extractor_class": Extractor,
        "features_extractor_kwargs": {"num_frames": num_frames},
        "net_arch": [],
    }
    agent = PPO(
        "MlpPolicy",
        VecFrameStack(env, num_frames) if num_frames > 1 else env,
        n_steps=STEPS // ENVS,
        seed=seed,
        device="cpu",
        policy_kwargs=network,
    )
    callback = TheirLaps(STEPS)
    agent.learn(batches * STEPS, callback=callback)
    return callback.laps


def run_ours(num_frames: int, batches: int, seed: int, compile: Compile) -> Laps:
    """Trains the recipe."""
    named = get_recipe("ppo/cartpole/enhanced-tit-protocol")
    assert isinstance(named, ppo.PPO)
    recipe = replace(
        named,
        backbone=replace(named.backbone, num_frames=num_frames),
        num_envs=ENVS,
        steps_per_batch=STEPS,
        total_steps=batches * STEPS,
        seed=seed,
        compile=compile,
    )
    return train(recipe)


def train(recipe: ppo.PPO) -> Laps:
    """Trains a recipe as the command line does, with checkpoints and metrics."""
    callback = OurLaps(recipe.steps_per_batch)
    with tempfile.TemporaryDirectory() as folder, Run.create(Path(folder, "run"), recipe) as run:
        runner.train(recipe, run, [callback])
        callback.laps.training_return = read_metrics(run.folder / "metrics.csv")[-1]["return_mean"]
    return callback.laps


def main() -> dict[str, Any]:
    """Measures with an empty compile cache."""
    numbers = {}
    for num_frames, (batches, rounds) in SETTINGS.items():
        with empty_compile_cache():
            runs = take_turns(num_frames, batches, rounds)
        numbers[f"K = {num_frames}"] = {
            name: {
                "steps_per_second": [laps.speed() for laps in found],
                "steps_per_second_of_processor_time": [laps.speed(1) for laps in found],
                "training_return": [laps.training_return for laps in found],
                "first_batch_seconds": [laps.ends[0][0] - laps.start for laps in found],
            }
            for name, found in runs.items()
        }
    return numbers


def take_turns(num_frames: int, batches: int, rounds: int) -> dict[str, list[Laps]]:
    """Runs both libraries in turns."""
    runs: dict[str, list[Laps]] = defaultdict(list)
    for seed in range(rounds):
        runs["sb3"].append(run_sb3(num_frames, batches, seed))
        for name, mode in MODES.items():
            runs[name].append(run_ours(num_frames, batches, seed, mode))
    return runs
