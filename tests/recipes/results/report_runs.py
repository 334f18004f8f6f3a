"""Run folders as `train` leaves them, with numbers that are made up."""

import csv
import json
from dataclasses import replace

import numpy as np

from recipes.core.recipe_json import recipe_to_json
from recipes.core.registry import get_recipe


def metrics_of(seed, rows=60, steps=1024):
    """Rows of PPO's metrics, by column: returns that rise, and a few others."""
    draw = np.random.default_rng(seed)
    step = steps * np.arange(1, rows + 1)
    rise = 1 - np.exp(-step / (0.3 * step[-1]))
    returns = 480 * rise + 15 * draw.random(rows)
    returns[0] = np.nan  # no episode has ended
    return {
        "step": step,
        "time": 1.7e9 + np.arange(rows),
        "steps_per_second": 900 + 50 * draw.random(rows),
        "return_mean": returns,
        "episodes": 10 + 5 * draw.random(rows),
        "epochs": np.full(rows, 10.0),
        "entropy": 0.69 * (1 - 0.8 * rise),
        "explained_variance": rise - 0.1,
        "kl_approx": 0.01 * draw.random(rows),
        "gradient_norm": 0.2 + draw.random(rows),
    }


def write_run(folder, of, seed=0, returns=None, metrics=None, evaluation=None, **fields):
    """Writes a run folder without a checkpoint; returns it.

    Args:
        returns: those of its evaluation, repeated as often as the recipe has episodes.
        metrics: the columns of its metrics.
        evaluation: other entries of its evaluation.
        **fields: other fields of the recipe.
    """
    recipe = replace(get_recipe(of), seed=seed, **fields)
    folder.mkdir(parents=True)
    (folder / "recipe.json").write_text(recipe_to_json(recipe))
    columns = metrics_of(seed) if metrics is None else metrics
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    if returns is not None:
        returns = list(map(float, returns)) * (recipe.evaluation_episodes // len(returns))
        whole = {
            "mean": float(np.mean(returns)),
            "std": float(np.std(returns)),
            "episodes": len(returns),
            "env": recipe.env,
            "steps": recipe.final_step,
            "returns": returns,
            "seed": recipe.evaluation_seed,
            "weights": "last",
        }
        (folder / "evaluation.json").write_text(json.dumps(whole | (evaluation or {})))
    versions = {"python": "3.11.7", "torch": "2.13.0", "torchrl-tit": "0.1.0"}
    (folder / "versions.json").write_text(json.dumps(versions))
    return folder
