"""d3rlpy's MLPs with its defaults: ``python -m benchmarks.d3rlpy_returns FILE.hdf5 ...``.

Observations are normalized, and IQL's rewards are, as by the recipes; behavior cloning has their
batch and learning rate, and CQL what d3rlpy's reproduction sets. ``benchmarks/offline.py`` says how
to install d3rlpy. A row is added to --out as soon as a run ends; runs that have a row are not
repeated.
"""

from __future__ import annotations

import argparse
from importlib.metadata import version
from pathlib import Path

import d3rlpy
import gymnasium as gym
import h5py
import numpy as np
import torch
from d3rlpy.algos import BCConfig, CQLConfig, IQLConfig, TD3PlusBCConfig
from d3rlpy.dataset import MDPDataset
from d3rlpy.logging import NoopAdapterFactory
from d3rlpy.models import VectorEncoderFactory
from d3rlpy.preprocessing import ReturnBasedRewardScaler, StandardObservationScaler
from gymnasium.wrappers import ClipAction

from .measuring import add_missing_rows
from .sb3_returns import EVALUATION_SEED

COLUMNS = ["data", "algorithm", "seed", "updates", "last", "last_std", "best", "d3rlpy"]
EPISODES, INTERVAL = 20, 5_000
_SCALED = {"observation_scaler": StandardObservationScaler()}
_WIDE = VectorEncoderFactory([256, 256, 256])
ALGORITHMS = {
    "bc": lambda: BCConfig(**_SCALED, learning_rate=3e-4, batch_size=256),
    "cql": lambda: CQLConfig(
        **_SCALED,
        actor_encoder_factory=_WIDE,
        critic_encoder_factory=_WIDE,
        alpha_learning_rate=0.0,
    ),
    "iql": lambda: IQLConfig(**_SCALED, reward_scaler=ReturnBasedRewardScaler(multiplier=1000)),
    "td3bc": lambda: TD3PlusBCConfig(**_SCALED),
}


def measure(file: Path, algorithm: str, seed: int, updates: int) -> list[object]:
    """Trains once, and evaluates the policy every 5,000 updates; returns a row."""
    d3rlpy.seed(seed)
    with h5py.File(file) as data:
        names = ("observations", "actions", "rewards", "terminals", "timeouts")
        dataset = MDPDataset(*(np.asarray(data[name]) for name in names))
        env = ClipAction(gym.make(data.attrs["env_id"]))
    learner = ALGORITHMS[algorithm]().create(device="cpu:0")
    rounds = learner.fitter(
        dataset,
        n_steps=updates,
        n_steps_per_epoch=min(INTERVAL, updates),
        show_progress=False,
        logger_adapter=NoopAdapterFactory(),
    )
    evaluations = [play(env, learner) for _ in rounds]
    means = [np.mean(returns) for returns in evaluations]
    reached = [round(float(x), 1) for x in (means[-1], np.std(evaluations[-1]), max(means))]
    return [file.stem, algorithm, seed, updates, *reached, version("d3rlpy")]


def play(env: gym.Env, learner: d3rlpy.algos.QLearningAlgoBase) -> list[float]:
    """Returns the returns of episodes."""
    returns = []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=EVALUATION_SEED + episode)
        total, ended = 0.0, False
        while not ended:
            [action] = learner.predict(observation[None].astype(np.float32))
            observation, reward, terminated, truncated, _ = env.step(action)
            total, ended = total + float(reward), terminated or truncated
        returns.append(total)
    return returns


def main(arguments: list[str] | None = None) -> None:
    """Trains all algorithms with all seeds on all files that have no row yet."""
    parser = argparse.ArgumentParser("python -m benchmarks.d3rlpy_returns")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="with env_id")
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=30_000)
    parser.add_argument("--out", type=Path, required=True, help="CSV that rows are added to")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    files = {file.stem: file for file in options.files}
    runs = [
        (name, algorithm, seed, options.updates)
        for seed in options.seeds
        for algorithm in options.algorithms
        for name in files
    ]
    add_missing_rows(options.out, COLUMNS, runs, lambda name, *rest: measure(files[name], *rest))


if __name__ == "__main__":
    main()
