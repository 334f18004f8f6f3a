"""Stable-Baselines3's PPO with its defaults: ``python -m benchmarks.sb3_returns ENV ...``.

A row is added to --out as soon as a run ends; runs that have a row are not repeated.
"""

from __future__ import annotations

import argparse
from importlib.metadata import version
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from .measuring import add_missing_rows

COLUMNS = [
    "env",
    "seed",
    "total_steps",
    "evaluation",
    "evaluation_std",
    "training_last_fifth",
    "stable_baselines3",
]
EVALUATION_SEED, EPISODES = 1_000_000, 100


class LastFifth(BaseCallback):
    """Keeps the returns of the training episodes that end in the last fifth of the steps.

    Args:
        total_steps: steps of the run.
    """

    def __init__(self, total_steps: int) -> None:
        super().__init__()
        self.begin = 0.8 * total_steps
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        if self.num_timesteps > self.begin:
            infos = self.locals["infos"]
            self.returns += [info["episode"]["r"] for info in infos if "episode" in info]
        return True


def measure(env: str, seed: int, total_steps: int) -> list[object]:
    """Trains once and evaluates the last weights with their most likely actions; returns a row."""
    agent = PPO("MlpPolicy", make_vec_env(env, seed=seed), seed=seed, device="cpu")
    last = LastFifth(total_steps)
    agent.learn(total_steps, callback=last)
    returns, _ = evaluate_policy(
        agent,
        make_vec_env(env, seed=EVALUATION_SEED),
        n_eval_episodes=EPISODES,
        return_episode_rewards=True,
    )
    training = round(fmean(last.returns), 1) if last.returns else ""
    reached = [round(float(np.mean(returns)), 1), round(float(np.std(returns)), 1), training]
    return [env, seed, total_steps, *reached, version("stable-baselines3")]


def main(arguments: list[str] | None = None) -> None:
    """Trains with all seeds on all environments that have no row yet."""
    parser = argparse.ArgumentParser("python -m benchmarks.sb3_returns")
    parser.add_argument("envs", nargs="+", metavar="ENV", help="Gymnasium's ids")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--total-steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, required=True, help="CSV that rows are added to")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    runs = [(env, seed, options.total_steps) for seed in options.seeds for env in options.envs]
    add_missing_rows(options.out, COLUMNS, runs, measure)


if __name__ == "__main__":
    main()
