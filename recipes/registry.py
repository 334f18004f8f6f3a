"""The named recipes: the paper's experiments as data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torchrl_tit.networks import (
    D2RLConfig,
    EnhancedTITConfig,
    MLPConfig,
    OFENetConfig,
    VanillaTITConfig,
)

from .atari import ATARI_RECIPES
from .cql_named import CQL_RECIPES
from .dt_named import DT_RECIPES
from .networks import NetworkConfig
from .no_velocity import NO_VELOCITY_RECIPES
from .ppo import PPO
from .recipe import Recipe, nearest, recipe_from_json
from .tuned import TUNED_TIT

# Task name: environment and steps (arXiv 2212.14538, appendix). The paper ran MuJoCo's v3.
_TASKS = {
    "acrobot": ("Acrobot-v1", 100_000),
    "cartpole": ("CartPole-v1", 100_000),
    "mountaincar": ("MountainCar-v0", 100_000),
    "ant": ("Ant-v5", 1_000_000),
    "halfcheetah": ("HalfCheetah-v5", 1_000_000),
    "hopper": ("Hopper-v5", 1_000_000),
    "walker2d": ("Walker2d-v5", 1_000_000),
}
# The paper leaves open which settings of TIT were used where, within patch 1, width 32 or 64, two
# blocks; these are the networks' defaults.
_ARRAY_NETWORKS: dict[str, NetworkConfig] = {
    "mlp": MLPConfig(),
    "ofenet": OFENetConfig(),
    "d2rl": D2RLConfig(),
    "vanilla-tit": VanillaTITConfig(),
    "enhanced-tit": EnhancedTITConfig(),
}
# Published by the authors for this task alone.
_MOUNTAINCAR_NETWORKS: dict[str, NetworkConfig] = {
    "vanilla-tit": VanillaTITConfig(
        embed_dim=32, num_heads_inner=4, num_heads_outer=8, features_dim=64
    ),
    "enhanced-tit": EnhancedTITConfig(
        embed_dim=16, num_heads_inner=4, num_heads_outer=8, features_dim=128
    ),
}


def _named() -> dict[str, Recipe]:
    recipes: dict[str, Recipe] = {}
    for task, (env, total_steps) in _TASKS.items():
        networks = _ARRAY_NETWORKS | (_MOUNTAINCAR_NETWORKS if task == "mountaincar" else {})
        for network, backbone in networks.items():
            name = f"ppo/{task}/{network}"
            recipe = PPO(name=name, env=env, total_steps=total_steps, backbone=backbone)
            recipes[name] = recipe
            if isinstance(backbone, EnhancedTITConfig | VanillaTITConfig):
                name += "-tuned"
                tuned = dict(TUNED_TIT[task])
                other = replace(backbone, **tuned.pop("backbone", {}))
                recipes[name] = replace(recipe, name=name, backbone=other, **tuned)
    return recipes | NO_VELOCITY_RECIPES | ATARI_RECIPES | CQL_RECIPES | DT_RECIPES


RECIPES: dict[str, Recipe] = _named()
"""Every named recipe."""


def get_recipe(name: str) -> Recipe:
    """Looks a recipe up.

    Raises:
        ValueError: if there is none of that name; the message names the nearest ones.

    Example:
        >>> get_recipe("ppo/cartpole/enhanced-tit").env
        'CartPole-v1'
    """
    if name not in RECIPES:
        raise ValueError(f"unknown recipe {name!r}: {nearest(name, RECIPES)}")
    return RECIPES[name]


def find_recipe(name: str) -> Recipe:
    """Looks a recipe up by name, or reads it from a JSON file such as a run's ``recipe.json``.

    Raises:
        ValueError: if there is none of that name, or the file holds none.
        FileNotFoundError: if there is no such file.

    Example:
        >>> find_recipe("ppo/pong/enhanced-tit").env
        'ALE/Pong-v5'
    """
    path = Path(name)
    if path.suffix == ".json":
        return recipe_from_json(path.read_bytes(), path)
    return get_recipe(name)
