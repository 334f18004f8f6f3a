"""PPO on CartPole end to end: our recipe compared with Stable-Baselines3 on the same network.

Both: Enhanced_TIT with K = 1 or 8, width 32, 2 blocks, 1 head and 64 features; 8 environments, 2048
steps per batch, minibatches of 64, 10 epochs, one thread. With K = 8, theirs reads stacked frames,
and ours trains on sequences. Speed is environment steps per second of processor time over whole
batches, collection and update together, without the first batch, in which libraries warm up and
compile.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
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
from recipes.core.recipe import Compile, Recipe
from recipes.core.registry import get_recipe
from recipes.core.run import Run

from .measuring import clock, empty_compile_cache
from .straightforward import StraightforwardTIT

CPU = torch.device("cpu")
STEPS, ENVS = 2048, 8
SETTINGS = {1: (5, 5), 8: (3, 3)}
"""How many batches a run has, and how many rounds there are, by the number of frames."""
MODES: dict[str, Compile] = {"compiled": "on", "ours": "off"}


class Laps:
    """The time at the end of each batch, in seconds.

    Args:
        steps: environment steps of a batch.
        device: of the networks.
    """

    def __init__(self, steps: int, device: torch.device = CPU) -> None:
        self.steps, self.device = steps, device
        self.ends: list[float] = []

    def add(self) -> None:
        self.ends.append(clock(self.device))

    def speed(self) -> float:
        """Environment steps per second, without the first batch."""
        return (len(self.ends) - 1) * self.steps / (self.ends[-1] - self.ends[0])


class Extractor(BaseFeaturesExtractor):
    """The straightforward network for Stable-Baselines3, whose frames are stacked in one array."""

    def __init__(self, space: Any, num_frames: int) -> None:
        super().__init__(space, 64)
        self.num_frames = num_frames
        self.network = StraightforwardTIT((space.shape[0] // num_frames,))

    def forward(self, observation: Tensor) -> Tensor:
        return self.network(observation.unflatten(1, (self.num_frames, -1)))


class TheirLaps(BaseCallback):
    """Records when each batch and its update end."""

    def __init__(self, laps: Laps) -> None:
        super().__init__()
        self.laps = laps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps:
            self.laps.add()

    def _on_training_end(self) -> None:
        self.laps.add()


class OurLaps(Callback):
    """Records when each update ends."""

    def __init__(self, laps: Laps) -> None:
        self.laps = laps

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        self.laps.add()
        return False


def run_sb3(num_frames: int, batches: int, seed: int) -> float:
    """Trains Stable-Baselines3 with the straightforward network; returns the speed."""
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
    laps = Laps(STEPS)
    agent.learn(batches * STEPS, callback=TheirLaps(laps))
    return laps.speed()


def run_ours(num_frames: int, batches: int, seed: int, compile: Compile) -> float:
    """Trains the recipe; returns the speed."""
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
    return train(recipe, Laps(STEPS))


def train(recipe: Recipe, laps: Laps) -> float:
    """Trains as the command line does, with checkpoints and metrics; returns the speed."""
    with tempfile.TemporaryDirectory() as folder, Run.create(Path(folder, "run"), recipe) as run:
        runner.train(recipe, run, [OurLaps(laps)])
    return laps.speed()


def main() -> dict[str, Any]:
    """Measures with an empty compile cache."""
    numbers = {}
    for num_frames, (batches, rounds) in SETTINGS.items():
        programs = {"sb3": partial(run_sb3, num_frames, batches)}
        for name, mode in MODES.items():
            programs[name] = partial(run_ours, num_frames, batches, compile=mode)
        numbers[f"K = {num_frames}"] = {
            name: {"steps_per_second_of_processor_time": speeds}
            for name, speeds in run_in_turns(programs, rounds).items()
        }
    return numbers


def run_in_turns(
    programs: Mapping[str, Callable[[int], float]], rounds: int
) -> dict[str, list[float]]:
    """Runs programs in turns, with the seeds 0, 1, ..., and an empty compile cache."""
    with empty_compile_cache():
        runs = [{name: run(seed) for name, run in programs.items()} for seed in range(rounds)]
    return {name: [one[name] for one in runs] for name in programs}
