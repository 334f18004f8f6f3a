"""PPO on Pong end to end: our recipes compared with Stable-Baselines3 and sb3-contrib.

All: 8 games, 1024 steps per batch, minibatches of 256, 3 epochs, images of 84 x 84. Theirs:
NatureCNN on 4 stacked frames; the same Enhanced_TIT as ours, straightforward; and RecurrentPPO with
NatureCNN and an LSTM. Speed is environment steps per second over whole batches, collection and
update together, without the first batch, in which libraries warm up and compile: of processor time
of one thread, and on a GPU on the clock.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import ale_py
import gymnasium
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack
from torch import Tensor

from recipes import ppo
from recipes.core.recipe import Compile
from recipes.core.registry import get_recipe

from .ppo_cartpole import Laps, TheirLaps, run_in_turns, train
from .straightforward import Case

STEPS, ENVS = 1024, 8
BATCHES, ROUNDS = 4, 3


class Extractor(BaseFeaturesExtractor):
    """The straightforward network on frames that are stacked as channels."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, 512)
        self.network = Case("Enhanced", "images", space.shape[0], 1).straightforward()

    def forward(self, observation: Tensor) -> Tensor:
        return self.network(observation)


def run_theirs(
    seed: int,
    device: torch.device,
    *,
    num_frames: int,
    policy: str = "CnnPolicy",
    agent: type = PPO,
    **network: Any,
) -> float:
    """Trains Stable-Baselines3 or sb3-contrib; returns the speed."""
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
        device=device,
        policy_kwargs={"net_arch": [], **network},
    )
    laps = Laps(STEPS, device)
    learner.learn(BATCHES * STEPS, callback=TheirLaps(laps))
    env.close()
    return laps.speed()


def run_ours(seed: int, device: torch.device, *, network: str, compile: Compile = "off") -> float:
    """Trains a recipe; returns the speed."""
    named = get_recipe(f"ppo/pong/{network}")
    assert isinstance(named, ppo.PPO)
    recipe = replace(
        named,
        total_steps=BATCHES * STEPS,
        seed=seed,
        compile=compile,
        device=str(device),
        evaluation_episodes=1,
    )
    return train(recipe, Laps(STEPS, device))


PROGRAMS: dict[str, Callable[..., float]] = {
    "sb3": partial(run_theirs, num_frames=4),
    "sb3, Enhanced_TIT": partial(run_theirs, num_frames=4, features_extractor_class=Extractor),
    "sb3-contrib, CNN-LSTM": partial(
        run_theirs, num_frames=1, policy="CnnLstmPolicy", agent=RecurrentPPO
    ),
    "NatureCNN": partial(run_ours, network="nature-cnn"),
    "Enhanced_TIT": partial(run_ours, network="enhanced-tit"),
    "Enhanced_TIT, compiled": partial(run_ours, network="enhanced-tit", compile="on"),
}


def main() -> dict[str, Any]:
    """Measures all programs in turns; on a GPU, eager ones."""
    device = torch.get_default_device()
    programs = {name: partial(program, device=device) for name, program in PROGRAMS.items()}
    if device.type != "cpu":
        del programs["Enhanced_TIT, compiled"]
    # Environments and agents choose the device of their tensors themselves.
    default: AbstractContextManager[Any] = (
        nullcontext() if device.type == "cpu" else torch.device("cpu")
    )
    with default:
        runs = run_in_turns(programs, ROUNDS)
    return {name: {"steps_per_second": speeds} for name, speeds in runs.items()}
