"""The recipes of the paper's tables on arrays: the protocol's settings, in every cell."""

from itertools import product

import pytest

from recipes.ppo import PPO
from recipes.registry import RECIPES
from torchrl_tit.networks import (
    D2RLConfig,
    EnhancedTITConfig,
    MLPConfig,
    OFENetConfig,
    VanillaTITConfig,
)

TASKS = {
    "acrobot": ("Acrobot-v1", 100_000),
    "cartpole": ("CartPole-v1", 100_000),
    "mountaincar": ("MountainCar-v0", 100_000),
    "ant": ("Ant-v5", 1_000_000),
    "halfcheetah": ("HalfCheetah-v5", 1_000_000),
    "hopper": ("Hopper-v5", 1_000_000),
    "walker2d": ("Walker2d-v5", 1_000_000),
}
NETWORKS = {
    "mlp": MLPConfig,
    "ofenet": OFENetConfig,
    "d2rl": D2RLConfig,
    "vanilla-tit": VanillaTITConfig,
    "enhanced-tit": EnhancedTITConfig,
}
SETTINGS = {
    "learning_rate": 3e-4, "decay_learning_rate": False, "warmup_steps": 0, "adam_eps": 1e-5,
    "max_grad_norm": 0.5, "num_envs": 1, "steps_per_batch": 2048, "minibatch_size": 64,
    "epochs": 10, "gamma": 0.99, "gae_lambda": 0.95, "bootstrap_time_limit": True,
    "clip_epsilon": 0.2, "decay_clip_epsilon": False, "entropy_coeff": 0.0, "critic_coeff": 0.5,
    "contrastive_coeff": 0.0, "clip_rewards": False, "reward_scale": 1.0, "history": 1,
    "hide_velocities": False, "initialization": "orthogonal", "evaluation_episodes": 100,
}  # fmt: skip
# Published for MountainCar alone: width, heads of outer blocks and inner blocks, features.
MOUNTAINCAR = {"vanilla-tit": (32, 8, 4, 64), "enhanced-tit": (16, 8, 4, 128)}


@pytest.mark.parametrize(("task", "network"), list(product(TASKS, NETWORKS)))
def test_every_cell_has_the_settings_of_the_protocol(task, network):
    recipe = RECIPES[f"ppo/{task}/{network}"]
    assert isinstance(recipe, PPO)
    assert (recipe.env, recipe.total_steps) == TASKS[task]
    assert {name: getattr(recipe, name) for name in SETTINGS} == SETTINGS
    assert type(recipe.backbone) is NETWORKS[network]


@pytest.mark.parametrize(("task", "network"), list(product(TASKS, MOUNTAINCAR)))
def test_settings_of_tit(task, network):
    backbone = vars(RECIPES[f"ppo/{task}/{network}"].backbone)
    width, outer, inner, features = (
        MOUNTAINCAR[network] if task == "mountaincar" else (32, 1, 1, 64)
    )
    expected = {
        "patch_size": 1, "embed_dim": width, "num_blocks": 2, "num_heads_outer": outer,
        "num_heads_inner": inner, "ffn_expansion_outer": 4, "ffn_expansion_inner": 4,
        "activation_outer": "gelu", "activation_inner": "gelu", "position_encoding": True,
        "temporal_position_encoding": False, "share_blocks": False, "features_dim": features,
        "activation_head": "tanh", "attention_dropout_inner": 0.0, "attention_dropout_outer": 0.0,
        "ffn_dropout_inner": 0.0, "ffn_dropout_outer": 0.0,
    }  # fmt: skip
    ablations = {"dense": True, "inner": True, "outer": True} if "enhanced" in network else {}
    assert backbone == expected | ablations


@pytest.mark.parametrize(("task", "network"), list(product(TASKS, ["mlp", "ofenet", "d2rl"])))
def test_the_trunks_have_two_tanh_layers_of_64(task, network):
    backbone = RECIPES[f"ppo/{task}/{network}"].backbone
    assert vars(backbone) == {"hidden_dim": 64, "num_layers": 2, "activation": "tanh"}


@pytest.mark.parametrize("task", ["ant", "halfcheetah", "hopper", "walker2d"])
@pytest.mark.parametrize("network", ["vanilla-tit", "enhanced-tit"])
def test_tuned_locomotion_takes_the_whole_observation_for_one_patch(task, network):
    recipe = RECIPES[f"ppo/{task}/{network}-tuned"]
    assert isinstance(recipe, PPO)
    recipe.check()
    env = recipe.make_env(1, seed=0)
    assert isinstance(recipe.backbone, EnhancedTITConfig | VanillaTITConfig)
    assert recipe.backbone.patch_size == env.observation_spec["history"].shape[-1]
