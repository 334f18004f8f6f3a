"""The named recipes have the settings of the papers, or of the results that docs/ shows."""

from __future__ import annotations

from fnmatch import fnmatch
from typing import Any

import pytest

from recipes.core.algorithm import make_algorithm
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import RECIPES, get_recipe
from torchrl_tit.settings.networks import decision_transformer, dt_tit, mlp

TASKS = ("halfcheetah", "hopper", "walker2d")
SETTINGS: dict[str, dict[str, Any]] = {
    # arXiv 2212.14538, appendix, with d3rlpy 1.1.1.
    "cql/*": {
        "actor_learning_rate": 1e-4,
        "critic_learning_rate": 3e-4,
        "temperature_learning_rate": 1e-4,
        "action_samples": 10,
        "batch_size": 256,
        "gamma": 0.99,
        "tau": 0.005,
        "critic": "mlp",
        "critic_hidden": (256, 256, 256),
        "over_critics": "mean",
        "time_limits": "drop",
        "unfinished": "drop",
        "final_step": 500_000,
        "evaluation_interval": 1000,
        "evaluation_episodes": 10,
    },
    "cql/*-medium-v0/*": {"conservative_weight": 10.0},
    "cql/*-replay-v0/*": {"conservative_weight": 5.0},
    "cql/*/mlp": {"backbone": mlp(hidden_dim=256, num_layers=3, activation="relu")},
    # docs/results/discrete_cql.md.
    "discrete-cql/*": {"conservative_weight": 1.0, "gamma": 0.99, "tau": 0.005},
    "discrete-cql/cartpole-*": {
        "env": "CartPole-v1",
        "batch_size": 64,
        "learning_rate": 3e-4,
        "final_step": 10_000,
        "evaluation_interval": 1000,
        "evaluation_episodes": 20,
    },
    "discrete-cql/pong-*": {
        "env": "ALE/Pong-v5",
        "batch_size": 32,
        "learning_rate": 1e-4,
        "padding": "constant",
        "final_step": 20_000,
        "evaluation_interval": 4000,
        "evaluation_episodes": 5,
    },
    # The papers of IQL and TD3+BC, for MuJoCo.
    "iql/*": {
        "expectile": 0.7,
        "temperature": 3.0,
        "learning_rate": 3e-4,
        "decay_learning_rate": True,
        "normalize_rewards": True,
    },
    "td3bc/*": {
        "alpha": 2.5,
        "policy_delay": 2,
        "policy_noise": 0.2,
        "noise_clip": 0.5,
        "actor_learning_rate": 3e-4,
        "critic_learning_rate": 3e-4,
        "normalize_observations": True,
    },
    "[it][qd][l3]*": {
        "tau": 0.005,
        "gamma": 0.99,
        "critic_hidden": (256, 256),
        "batch_size": 256,
        "final_step": 1_000_000,
        "evaluation_interval": 5000,
        "evaluation_episodes": 10,
    },
    # arXiv 2106.01345, appendix.
    "dt/*": {
        "final_step": 100_000,
        "batch_size": 64,
        "learning_rate": 1e-4,
        "warmup_updates": 10_000,
        "weight_decay": 1e-4,
        "max_grad_norm": 0.25,
        "evaluation_episodes": 100,
        "return_scale": 1000,
    },
    "dt/*/dt": {"backbone": decision_transformer(20)},
    "dt/*/dt-tit": {"backbone": dt_tit(20)},
    "dt/halfcheetah-*": {"target_returns": (12000, 6000)},
    "dt/hopper-*": {"target_returns": (3600, 1800)},
    "dt/walker2d-*": {"target_returns": (5000, 2500)},
    # The release of Online Decision Transformer.
    "odt/*/odt": {
        "backbone": decision_transformer(
            20, embed_dim=512, num_blocks=4, num_heads=4, timestep_embedding=False
        ),
        "acting_num_frames": 5,
        "batch_size": 256,
        "capacity": 1000,
        "learning_rate": 1e-4,
        "weight_decay": 5e-4,
        "warmup_updates": 10_000,
        "pretraining_updates": 5000,
        "updates_per_round": 300,
        "rounds": 1500,
        "alpha_init": 0.1,
        "evaluation_interval": 10,
        "evaluation_episodes": 10,
        "online_return": 7200,
        "target_returns": (3600,),
    },
    "sac/hopper/*": {"final_step": 1_000_000, "learning_rate": 3e-4, "tau": 0.005},
    # CleanRL's dqn_atari.py, whose target network is copied every 1000 steps.
    "dqn/pong/*": {
        "batch_size": 32,
        "learning_rate": 1e-4,
        "gamma": 0.99,
        "buffer_size": 1_000_000,
        "random_steps": 80_000,
        "target_interval": 250,
        "updates_per_step": 0.25,
        "final_epsilon": 0.01,
        "exploration_fraction": 0.1,
        "double": True,
        "clip_rewards": True,
    },
}


@pytest.mark.parametrize("pattern", SETTINGS)
def test_settings(pattern: str) -> None:
    names = [name for name in RECIPES if fnmatch(name, pattern)]
    assert names
    for name in names:
        recipe = get_recipe(name)
        found = {field: getattr(recipe, field) for field in SETTINGS[pattern]}
        assert found == SETTINGS[pattern], name
        assert recipe_from_json(recipe_to_json(recipe), name) == recipe


def test_names() -> None:
    def named(algorithm: str, kinds: str, version: int, networks: str) -> set[str]:
        sets = [f"{task}-{kind}-v{version}" for task in TASKS for kind in kinds.split()]
        return {f"{algorithm}/{data}/{network}" for data in sets for network in networks.split()}

    both, all_three = "medium medium-replay", "medium medium-replay medium-expert"
    expected = named("cql", both, 0, "mlp enhanced-tit") | named("dt", both, 2, "dt dt-tit")
    for algorithm in ("bc", "iql", "td3bc"):
        expected |= named(algorithm, all_three, 2, "mlp enhanced-tit vanilla-tit")
    algorithms = ("cql/", "dt/", "bc/", "iql/", "td3bc/")
    assert {name for name in RECIPES if name.startswith(algorithms)} == expected


@pytest.mark.parametrize("name", ["sac/hopper/mlp", "odt/hopper-medium-replay-v2/odt-small"])
def test_builds(name: str) -> None:
    make_algorithm(get_recipe(name)).check()
