"""Off-policy evaluation beside the truth: twelve policies of CartPole, ranked from data alone.

The set is the mixed one of ``data collect``: everything that PPO saw while it learned. The policies
are one that discrete CQL learns from it, and copies whose weights have noise of growing scale. The
truth is the mean discounted return of 50 episodes, with a discount factor of 0.95.
"""

from __future__ import annotations

import copy
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr

from recipes.cql import DiscreteCQL, DiscreteCQLAlgorithm
from recipes.offline import read_data
from recipes.tools.collect import Collection
from recipes.tools.collect.collect import collect
from recipes.tools.off_policy import fitted_q, weighted_returns
from torchrl_tit.evaluation import evaluate
from torchrl_tit.settings.networks import mlp

TASK, AGENT = "CartPole-v1", "ppo/cartpole/mlp"
POLICIES, EPISODES = 12, 50
UPDATES = {"policy": 500, "fqe": 1000, "wis": 100}
"""Gradient steps; estimates of the command take more."""


def main() -> dict[str, Any]:
    """Ranks the policies by fitted Q evaluation and by weighted importance sampling."""
    with tempfile.TemporaryDirectory() as folder:
        mixed = Collection(env=TASK, agent=AGENT, sets=("mixed",), total_steps=20_480)
        collect(mixed, Path(folder), "")
        recipe = DiscreteCQL(
            env=TASK,
            dataset=str(Path(folder, "mixed.hdf5")),
            backbone=mlp(hidden_dim=64),
            normalize_observations=True,
            gamma=0.95,
            compile="off",
        )
        torch.manual_seed(0)
        algorithm = DiscreteCQLAlgorithm(recipe)
        algorithm.prepare(0, Path(folder))
        batches = algorithm.batches()
        for step in range(UPDATES["policy"]):
            algorithm.update(next(batches), step)
        episodes = read_data(recipe)
    weights = copy.deepcopy(algorithm.model.state_dict())
    generator = torch.Generator().manual_seed(0)
    found: dict[str, list[float]] = {name: [] for name in ("noise", "truth", "fqe")}
    weighed = 0
    for noise in np.linspace(0, 2, POLICIES).tolist():
        algorithm.model.load_state_dict(weights)
        for parameter in algorithm.model.parameters():
            drawn = torch.randn(parameter.shape, generator=generator)
            parameter.data.add_(noise * parameter.data.square().mean().sqrt() * drawn)
        returns = evaluate(algorithm.make_env, algorithm.policy, EPISODES, seed=0, shrink=True)
        estimate = fitted_q(algorithm, episodes, UPDATES["fqe"])
        with suppress(ValueError):  # no episode has a weight
            weighted_returns(algorithm, episodes, None, UPDATES["wis"])
            weighed += 1
        truth = discounted(returns.double().numpy(), estimate["gamma"]).mean()
        for name, value in zip(found, (noise, truth, estimate["value"]), strict=True):
            found[name].append(float(f"{value:.4g}"))
        print(*(f"{name} {values[-1]:g}" for name, values in found.items()), flush=True)
    truths, estimates = np.array(found["truth"]), np.array(found["fqe"])
    measured = {
        "transitions": episodes.num_transitions,
        "updates": UPDATES["fqe"],
        "data": float(f"{estimate['data_value']:.4g}"),
        **found,
        "weighed": weighed,
        "rank_correlation": float(spearmanr(truths, estimates).statistic),
        "best": truths.max(),
        "chosen": truths[estimates.argmax()],
    }
    return {TASK: measured}


def discounted(returns: NDArray, gamma: float) -> NDArray:
    """Discounted returns of episodes in which every step pays 1."""
    return (1 - gamma**returns) / (1 - gamma)
