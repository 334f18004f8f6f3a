"""Stable-Baselines3's PPO with its defaults: ``python -m benchmarks.sb3_returns ENV ...``.

A row is added to --out as soon as a run ends; runs that have a row are not repeated.
"""

from __future__ import annotations

import argparse
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from stable_baselines3 import PPO
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


def measure(env: str, seed: int, total_steps: int) -> list[object]:
    """Trains once and evaluates the last weights with their most likely actions; returns a row."""
    envs = make_vec_env(env, seed=seed)
    agent = PPO("MlpPolicy", envs, seed=seed, device="cpu")
    agent.learn(total_steps)
    [returns] = envs.env_method("get_episode_rewards")
    [lengths] = envs.env_method("get_episode_lengths")
    ends, begin = accumulate(lengths), 0.8 * total_steps  # of the last fifth
    last = [x for x, end in zip(returns, ends, strict=True) if end > begin]
    evaluated, _ = evaluate_policy(
        agent,
        make_vec_env(env, seed=EVALUATION_SEED),
        n_eval_episodes=EPISODES,
        return_episode_rewards=True,
    )
    training = round(fmean(last), 1) if last else ""
    reached = [round(float(np.mean(evaluated)), 1), round(float(np.std(evaluated)), 1), training]
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
