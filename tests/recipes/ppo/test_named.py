"""The recipes of the paper's tables on arrays: one set of settings, and the protocol's."""

from dataclasses import replace
from itertools import product
from typing import Any

import pytest

from recipes.core.algorithm import make_algorithm
from recipes.core.registry import RECIPES
from recipes.ppo import PPO
from recipes.presets.ppo_memory import MEMORY_RECIPES, MEMORY_SETTINGS
from recipes.presets.ppo_settings import PPO_SETTINGS
from torchrl_tit.settings.networks import d2rl, enhanced_tit, mlp, ofenet, vanilla_tit

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
    "mlp": mlp,
    "ofenet": ofenet,
    "d2rl": d2rl,
    "vanilla-tit": vanilla_tit,
    "enhanced-tit": enhanced_tit,
}
SETTINGS = {
    "learning_rate": 3e-4, "decay_learning_rate": False, "warmup_steps": 0, "adam_eps": 1e-5,
    "max_grad_norm": 0.5, "num_envs": 1, "steps_per_batch": 2048, "minibatch_size": 64,
    "epochs": 10, "gamma": 0.99, "gae_lambda": 0.95, "bootstrap_time_limit": True,
    "clip_epsilon": 0.2, "decay_clip_epsilon": False, "entropy_coeff": 0.0, "critic_coeff": 0.5,
    "contrastive_coeff": 0.0, "clip_rewards": False, "reward_scale": 1.0,
    "hide_velocities": False, "initialization": "orthogonal", "evaluation_episodes": 100,
}  # fmt: skip
# Published for MountainCar alone: width, heads of outer blocks and inner blocks, features.
MOUNTAINCAR = {"vanilla-tit": (32, 8, 4, 64), "enhanced-tit": (16, 8, 4, 128)}


@pytest.mark.parametrize(("task", "network"), list(product(TASKS, NETWORKS)))
def test_every_cell_has_the_settings_of_the_protocol(task, network):
    recipe = RECIPES[f"ppo/{task}/{network}-protocol"]
    assert isinstance(recipe, PPO)
    assert (recipe.env, recipe.total_steps) == TASKS[task]
    assert {name: getattr(recipe, name) for name in SETTINGS} == SETTINGS
    assert recipe.backbone.num_frames == 1
    assert type(recipe.backbone.history) is type(NETWORKS[network]().history)


@pytest.mark.parametrize(("task", "network"), list(product(TASKS, MOUNTAINCAR)))
def test_settings_of_tit(task, network):
    width, outer, inner, features = (
        MOUNTAINCAR[network] if task == "mountaincar" else (32, 1, 1, 64)
    )
    expected: dict[str, Any] = {
        "patch_size": 1, "embed_dim": width, "num_blocks": 2, "num_heads_outer": outer,
        "num_heads_inner": inner, "ffn_expansion_outer": 4, "ffn_expansion_inner": 4,
        "activation_outer": "gelu", "activation_inner": "gelu", "position_encoding": True,
        "temporal_positions": "none", "share_blocks": False, "features_dim": features,
        "activation_head": "tanh", "attention_dropout_inner": 0.0, "attention_dropout_outer": 0.0,
        "ffn_dropout_inner": 0.0, "ffn_dropout_outer": 0.0,
    }  # fmt: skip
    assert RECIPES[f"ppo/{task}/{network}-protocol"].backbone == NETWORKS[network](1, **expected)


@pytest.mark.parametrize(("task", "network"), list(product(TASKS, ["mlp", "ofenet", "d2rl"])))
def test_the_trunks_have_two_tanh_layers_of_64(task, network):
    backbone = RECIPES[f"ppo/{task}/{network}"].backbone
    expected = {"hidden_dim": 64, "num_layers": 2, "activation": "tanh"}
    assert vars(backbone.history) == expected
    assert (backbone.trunks, backbone.head.features_dim) == ("separate", None)


def test_all_tasks_and_networks_train_with_one_set_of_settings():
    """Only the task, the number of steps and what the network reads differ."""
    recipes = [
        recipe
        for name, recipe in RECIPES.items()
        if isinstance(recipe, PPO) and not name.endswith("-protocol") and "ALE" not in recipe.env
    ]
    memory = [recipe for recipe in recipes if recipe.name in MEMORY_RECIPES]
    others = [recipe for recipe in recipes if recipe.name not in MEMORY_RECIPES]
    assert len({recipe.env for recipe in others}) == 7  # the paper's
    assert len({recipe.env for recipe in memory}) == 6
    _check_one_set(others, PPO_SETTINGS)
    # In long T-Mazes, sequences are as long as the corridor, batches grow with them, and the floor
    # falls with the price of a step.
    long = [recipe for recipe in memory if recipe.steps_per_sequence > 64]
    assert {recipe.name.split("/")[1] for recipe in long} == {"tmaze-250", "tmaze-500"}
    assert {recipe.advantage_floor for recipe in long} == {25 / 250, 25 / 500}
    fields = ("steps_per_batch", "minibatch_size", "sequence_length")
    short = {name: MEMORY_SETTINGS[name] for name in fields} | {"advantage_floor": 0.5}
    memory = [replace(recipe, **short) if recipe in long else recipe for recipe in memory]
    mazes = [recipe for recipe in memory if recipe.env == "TMaze-v0"]
    _check_one_set(mazes, MEMORY_SETTINGS | {"entropy_coeff": 0.05, "advantage_floor": 0.5})
    _check_one_set([recipe for recipe in memory if recipe not in mazes], MEMORY_SETTINGS)


def _check_one_set(recipes, settings):
    one = PPO(env="one", backbone=mlp(), **settings)
    same: dict[str, Any] = {
        "env": "one",
        "env_settings": (),
        "wrappers": (),
        "backbone": mlp(),
        "total_steps": one.total_steps,
        "name": "",
        "hide_velocities": False,
    }
    assert {replace(recipe, **same) for recipe in recipes} == {one}


def test_all_tit_networks_differ_only_in_frames_and_positions():
    no_positions: dict[str, Any] = {"temporal_positions": "none"}
    networks = {
        replace(
            recipe.backbone,
            num_frames=1,
            history=replace(recipe.backbone.history, **no_positions),
        )
        for name, recipe in RECIPES.items()
        if isinstance(recipe, PPO)
        and "enhanced-tit" in name
        and not name.endswith("-protocol")
        and "wo-outer" not in name
        and "ALE" not in recipe.env
        and "MiniGrid" not in recipe.env  # whose patch is a tile
    }
    assert networks == {enhanced_tit(patch_size="auto", patch_weights="own")}


@pytest.mark.parametrize("task", ["ant", "cartpole", "hopper"])
def test_the_whole_observation_is_one_patch(task):
    algorithm = make_algorithm(RECIPES[f"ppo/{task}/enhanced-tit"])
    algorithm.check()
    (frames,) = algorithm.policy[0].module.frames
    (size,) = frames.observation_shape
    assert frames.encoder.patch_embedding.num_patches == 1
    assert frames.encoder.patch_embedding.weight.shape[-1] == size
