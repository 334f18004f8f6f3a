"""PPO on Pong end to end: our recipes compared with Stable-Baselines3 and sb3-contrib.

All: 8 games, 1024 steps per batch, minibatches of 256, 3 epochs, one thread, images of 84 x 84.
Theirs: NatureCNN on 4 stacked frames; the same Enhanced_TIT as ours, straightforward, on 4 frames;
and RecurrentPPO with NatureCNN and an LSTM. Speed is environment steps per second over whole
batches, collection and update together, without the first batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import ale_py
import gymnasium
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack
from torch import Tensor

from recipes import ppo
from recipes.core.recipe import Compile
from recipes.core.registry import get_recipe

from .measuring import empty_compile_cache
from .ppo_cartpole import Laps, TheirLaps, train
from .straightforward import Case

STEPS, ENVS = 1024, 8
BATCHES, ROUNDS = 3, 5


class Extractor(BaseFeaturesExtractor):
    """The straightforward network on frames that are stacked as channels."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, 512)
        self.network = Case("Enhanced", "images", space.shape[0], 1).straightforward()

    def forward(self, observation: Tensor) -> Tensor:
        return self.network(observation)


def run_theirs(seed: int, num_frames: int, policy: str, agent: type = PPO, **network: Any) -> Laps:
    """Trains Stable-Baselines3 or sb3-contrib."""
    gymnasium.register_envs(ale_py)
    env = VecFrameStack(make_atari_env("PongNoFrameskip-v4", ENVS, seed=seed), num_frames)
    learner = agent(
        policy,
        env,
        n_steps=STEPS // ENVS,
        batch_size=256,
        n_epochs=3,
        learning_rate=2.5e-4,
        clip_range=0.1,
        ent_coef=0.01,
        seed=seed,
        device="cpu",
        policy_kwargs={"net_arch": [], **network},
    )
    callback = TheirLaps(STEPS)
    learner.learn(BATCHES * STEPS, callback=callback)
    env.close()
    return callback.laps


def run_ours(seed: int, network: str, compile: Compile) -> Laps:
    """Trains a recipe."""
    named = get_recipe(f"ppo/pong/{network}")
    assert isinstance(named, ppo.PPO)
    return train(replace(named, total_steps=BATCHES * STEPS, seed=seed, compile=compile))


PROGRAMS: dict[str, Callable[[int], Laps]] = {
    "sb3": partial(run_theirs, num_frames=4, policy="CnnPolicy"),
    "NatureCNN": partial(run_ours, network="nature-cnn", compile="off"),
    "Enhanced_TIT": partial(run_ours, network="enhanced-tit", compile="off"),
    "Enhanced_TIT, compiled": partial(run_ours, network="enhanced-tit", compile="on"),
    "sb3, Enhanced_TIT": partial(
        run_theirs, num_frames=4, policy="CnnPolicy", features_extractor_class=Extractor
    ),
    "sb3-contrib, CNN-LSTM": partial(
        run_theirs, num_frames=1, policy="CnnLstmPolicy", agent=RecurrentPPO
    ),
}


def main() -> dict[str, Any]:
    """Measures all programs in turns, with an empty compile cache."""
    runs: dict[str, list[Laps]] = defaultdict(list)
    with empty_compile_cache():
        for seed in range(ROUNDS):
            for name, program in PROGRAMS.items():
                runs[name].append(program(seed))
    return {
        name: {"steps_per_second_of_processor_time": [laps.speed(1) for laps in found]}
        for name, found in runs.items()
    }
