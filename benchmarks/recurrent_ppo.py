"""sb3-contrib's RecurrentPPO on MiniGrid-Memory: ``python -m benchmarks.recurrent_ppo --out FILE``.

The environments are those of the recipes ``ppo/memory-s7/...``. Success, and when training ends
early, are defined as in ``benchmarks.memory_tasks``. Steps per second are those of all of training.
The settings are the library's defaults but for the convolutions, which take smaller images; or with
``--settings recipe`` those of these recipes, as far as the library has them. Rewards and pixels are
then normalized in the environment, by running statistics, as are pixels in the recipes.
A row is added to --out as soon as a run ends; runs that have a row are not repeated.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import Any

import gymnasium
import torch
from minigrid.wrappers import ImgObsWrapper, RGBImgPartialObsWrapper
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage
from torch import Tensor, nn

from recipes.core.registry import get_recipe
from recipes.ppo import PPO
from torchrl_tit.tasks import FirstActions

from .measuring import add_missing_rows
from .memory_tasks import SOLVED, VALIDATION_SEED, Successes
from .sb3_returns import EVALUATION_SEED

COLUMNS = [
    "size",
    "seed",
    "total_steps",
    "settings",
    "steps",
    "weights",
    "steps_to_0.9",
    "success",
    "return",
    "steps_per_second",
    "processor_steps_per_second",
    "sb3_contrib",
]
TOTAL_STEPS, EPISODES = 1_000_000, 100
"""The steps of a run, and the episodes of its evaluation."""
THRESHOLD = 0.0
"""Successful episodes return more."""
NUM_ENVS = 16
"""As in the recipes. With the default of 128 steps in each, a batch has 2,048 steps, as there."""


class Tiles(BaseFeaturesExtractor):
    """A convolution over the tiles, another over their 3 x 3 neighborhood, and a linear layer.

    The default, NatureCNN, takes images of 36 x 36 pixels or more, and these have 24 x 24. Like
    NatureCNN, it ends with a ReLU.

    Args:
        observation_space: that of images of 3 x 3 tiles, channels first.
        features_dim: number of features.
    """

    def __init__(
        self,
        observation_space: gymnasium.spaces.Box,
        features_dim: int = 64,
    ) -> None:
        super().__init__(observation_space, features_dim)
        channels = observation_space.shape[0]
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 32, kernel_size=8, stride=8),
            nn.ReLU(),
            nn.Conv2d(32, 64, kernel_size=3),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(64, features_dim),
            nn.ReLU(),
        )

    def forward(self, observations: Tensor) -> Tensor:
        return self.layers(observations)


def _settings_of(name: str) -> PPO:
    recipe = get_recipe(name)
    assert isinstance(recipe, PPO)
    return recipe


_RECIPE = _settings_of("ppo/memory-s7/lstm")
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "recipe": {
        "batch_size": _RECIPE.minibatch_size,
        "n_epochs": _RECIPE.epochs,
        "gamma": _RECIPE.gamma,
        "gae_lambda": _RECIPE.gae_lambda,
        "ent_coef": _RECIPE.entropy_coeff,
        "target_kl": _RECIPE.target_kl,
        "learning_rate": lambda left: _RECIPE.learning_rate * left,  # left falls from 1 to 0
    },
}
"""All other settings are the library's defaults, so the actor and the critic have an LSTM each: of
256 entries by default, with those of the recipe of 64, as there."""


class Progress(BaseCallback):
    """Counts successful episodes, batch by batch, and ends training when nearly all are.

    Args:
        validate: returns the share of successes with the most likely actions.
    """

    def __init__(self, validate: Callable[[], float]) -> None:
        super().__init__()
        self.validate = validate
        self.successes = Successes(Path(), step=0, threshold=THRESHOLD)  # is not saved
        self._returns: list[float] = []
        self._solved = False

    def _on_rollout_start(self) -> None:
        if self.successes.updated(self.num_timesteps, None):
            self._solved = self.validate() >= SOLVED
            self.successes.start_again()

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        self._returns += [info["episode"]["r"] for info in infos if "episode" in info]
        return not self._solved

    def _on_rollout_end(self) -> None:
        right = sum(value > THRESHOLD for value in self._returns)
        self.successes.add(self.num_timesteps, len(self._returns), right)
        self._returns.clear()


def make_env(size: int) -> gymnasium.Env[Any, Any]:
    """Returns the environment of the recipes: partial views as images, and the first 3 actions."""
    env: gymnasium.Env[Any, Any] = gymnasium.make(
        f"MiniGrid-MemoryS{size}-v0", agent_view_size=3, max_episode_steps=96
    )
    return FirstActions(ImgObsWrapper(RGBImgPartialObsWrapper(env, tile_size=8)), count=3)


def make_envs(size: int, seed: int) -> VecEnv:
    """Returns copies of the environment, with the channels of images first."""
    return VecTransposeImage(make_vec_env(partial(make_env, size), NUM_ENVS, seed=seed))


def measure(size: int, seed: int, total_steps: int, settings: str) -> list[object]:
    """Trains once and evaluates the last weights with their most likely actions; returns a row."""

    def evaluate(seed: int) -> list[float]:
        test_envs = make_envs(size, seed)
        if like_recipe:
            test_envs = VecNormalize(test_envs, training=False, norm_reward=False)
            test_envs.obs_rms = envs.obs_rms
        returns, _ = evaluate_policy(agent, test_envs, EPISODES, return_episode_rewards=True)
        assert isinstance(returns, list)
        return returns

    def success(returns: list[float]) -> float:
        return fmean(value > THRESHOLD for value in returns)

    like_recipe = settings == "recipe"
    envs: Any = make_envs(size, seed)
    network: dict[str, Any] = {"features_extractor_class": Tiles}
    if like_recipe:
        envs = VecNormalize(envs, gamma=_RECIPE.gamma)
        network |= {"lstm_hidden_size": 64, "normalize_images": False}
    agent = RecurrentPPO(
        "CnnLstmPolicy",
        envs,
        seed=seed,
        device="cpu",
        policy_kwargs=network,
        **SETTINGS[settings],
    )
    progress = Progress(lambda: success(evaluate(VALIDATION_SEED)))
    start, processor_start = time.perf_counter(), time.process_time()
    agent.learn(total_steps, callback=progress)
    seconds, processor = time.perf_counter() - start, time.process_time() - processor_start
    returns = evaluate(EVALUATION_SEED)
    return [
        size,
        seed,
        total_steps,
        settings,
        progress.successes.batches[-1][0],
        sum(weight.numel() for weight in agent.policy.parameters()),
        progress.successes.reached(),
        success(returns),
        round(fmean(returns), 4),
        round(agent.num_timesteps / seconds, 1),
        round(agent.num_timesteps / processor, 1),
        version("sb3-contrib"),
    ]


def main(arguments: list[str] | None = None) -> None:
    """Trains with all seeds that have no row yet."""
    parser = argparse.ArgumentParser("python -m benchmarks.recurrent_ppo")
    parser.add_argument("--size", type=int, default=7, help="of MiniGrid-MemoryS{size}-v0")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--settings", choices=SETTINGS, default="default")
    parser.add_argument("--out", type=Path, required=True, help="CSV that rows are added to")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    runs = [(options.size, seed, TOTAL_STEPS, options.settings) for seed in options.seeds]
    add_missing_rows(options.out, COLUMNS, runs, measure)


if __name__ == "__main__":
    main()
