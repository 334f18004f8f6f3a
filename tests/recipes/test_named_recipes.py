"""The named recipes have the settings of the papers, or of the results that docs/ shows."""

from __future__ import annotations

from dataclasses import replace
from fnmatch import fnmatch
from importlib.util import find_spec
from operator import attrgetter
from typing import Any

import pytest
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from recipes.core.algorithm import make_algorithm
from recipes.core.recipe import LENGTHS, DatasetRecipe, recipe_classes
from recipes.core.registry import RECIPES, get_recipe
from recipes.ppo import PPO
from recipes.presets import ppo_atari, ppo_memory, ppo_minatar
from recipes.presets.ppo_settings import PICTURE_SETTINGS, PPO_SETTINGS, STEADY_PPO_SETTINGS
from torchrl_tit.settings import Inner
from torchrl_tit.settings.networks import (
    catformer,
    coberl,
    d2rl,
    dt_tit,
    enhanced_tit,
    mlp,
    ofenet,
    vanilla_tit,
)

ARRAYS = {
    "acrobot": ("Acrobot-v1", 100_000), "cartpole": ("CartPole-v1", 100_000),
    "mountaincar": ("MountainCar-v0", 100_000), "ant": ("Ant-v5", 1_000_000),
    "halfcheetah": ("HalfCheetah-v5", 1_000_000), "hopper": ("Hopper-v5", 1_000_000),
    "walker2d": ("Walker2d-v5", 1_000_000),
}  # fmt: skip
GAMES = {
    "breakout": "ALE/Breakout-v5", "mspacman": "ALE/MsPacman-v5", "pong": "ALE/Pong-v5",
    "spaceinvaders": "ALE/SpaceInvaders-v5",
}  # fmt: skip
PICTURES = [recipe.name for recipe in (*ppo_atari.RECIPES, *ppo_minatar.RECIPES)]
MEMORIES = [recipe.name for recipe in ppo_memory.RECIPES]
PAPERS = ("-protocol", "-paper", "-tuned")
"""How the names of recipes end that have the paper's settings."""
ABLATED = ["enhanced-tit", *(f"enhanced-tit-wo-{part}" for part in ("dense", "inner", "outer"))]
IMAGE_NETWORKS = ["nature-cnn", "resnet", "catformer", "coberl", "vanilla-tit", *ABLATED]
TANH_64: dict[str, Any] = {"hidden_dim": 64, "num_layers": 2, "activation": "tanh"}
TIT_OF_ARRAYS: dict[str, Any] = {
    "patch_size": 1, "embed_dim": 32, "num_blocks": 2, "num_heads_outer": 1, "num_heads_inner": 1,
    "ffn_expansion_outer": 4, "ffn_expansion_inner": 4, "activation_outer": "gelu",
    "activation_inner": "gelu", "position_encoding": True, "temporal_positions": "none",
    "share_blocks": False, "features_dim": 64, "activation_head": "tanh",
    "attention_dropout_inner": 0.0, "attention_dropout_outer": 0.0, "ffn_dropout_inner": 0.0,
    "ffn_dropout_outer": 0.0,
}  # fmt: skip
MOUNTAINCAR: dict[str, Any] = {
    **TIT_OF_ARRAYS, "num_heads_outer": 8, "num_heads_inner": 4, "features_dim": 128,
}  # fmt: skip
TIT_OF_IMAGES: dict[str, Any] = {
    **TIT_OF_ARRAYS, "patch_size": 12, "embed_dim": 64, "num_heads_outer": 4, "num_heads_inner": 4,
    "features_dim": 512, "activation_head": "gelu", "attention_dropout_inner": 0.1,
    "attention_dropout_outer": 0.1, "ffn_dropout_inner": 0.1, "ffn_dropout_outer": 0.1,
}  # fmt: skip

SETTINGS: dict[str, dict[str, Any]] = {
    # The protocol of arXiv 2212.14538, appendix; MountainCar's TiTs have settings of their own.
    **{
        f"ppo/{task}/*-protocol": {
            "env": env, "total_steps": steps,
            "learning_rate": 3e-4, "decay_learning_rate": False, "warmup_steps": 0,
            "adam_eps": 1e-5, "max_grad_norm": 0.5, "num_envs": 1, "steps_per_batch": 2048,
            "minibatch_size": 64, "epochs": 10, "gamma": 0.99, "gae_lambda": 0.95,
            "clip_epsilon": 0.2, "decay_clip_epsilon": False,
            "entropy_coeff": 0.0, "critic_coeff": 0.5,
            "clip_rewards": False, "reward_scale": 1.0, "hide_velocities": False,
            "initialization": "orthogonal", "evaluation_episodes": 100, "backbone.num_frames": 1,
        }
        for task, (env, steps) in ARRAYS.items()
    },
    **{
        f"ppo/{task}/{network.history.name}*": {
            "backbone.history": network.history, "backbone.trunks": "separate",
            "backbone.head.features_dim": None,
        }
        for task in ARRAYS
        for network in (mlp(**TANH_64), ofenet(**TANH_64), d2rl(**TANH_64))
    },
    **{
        f"ppo/{task}/{name}-protocol": {"backbone": network(1, **hyperparameters)}
        for task in ARRAYS
        for name, network, hyperparameters in (
            (
                "vanilla-tit", vanilla_tit,
                {**MOUNTAINCAR, "features_dim": 64} if task == "mountaincar" else TIT_OF_ARRAYS,
            ),
            (
                "enhanced-tit", enhanced_tit,
                {**MOUNTAINCAR, "embed_dim": 16} if task == "mountaincar" else TIT_OF_ARRAYS,
            ),
        )
    },
    # The paper's letter, where its code has other values.
    "ppo/mountaincar/vanilla-tit-paper": {"backbone": vanilla_tit(**TIT_OF_ARRAYS)},
    "ppo/mountaincar/enhanced-tit-paper": {"backbone": enhanced_tit(**TIT_OF_ARRAYS)},
    "cql/*/enhanced-tit-paper": {
        "backbone.frame.num_blocks": 2, "backbone.frame.embed_dim": 256,
        "backbone.frame.num_heads": 1, "backbone.history.num_heads": 4,
        "backbone.frame.attention_dropout": 0.0, "backbone.frame.ffn_dropout": 0.0,
        "backbone.history.attention_dropout": 0.0, "backbone.history.ffn_dropout": 0.1,
        "backbone.frame.position_encoding": True,
    },
    "dt/*/dt-tit-paper": {"backbone": dt_tit(20, position_encoding=True)},
    **{
        f"ppo/{game}/{network}-protocol": {
            "env": env, "padding": "constant", "num_envs": 8, "steps_per_batch": 1024,
            "minibatch_size": 64 if "tit" in network else 256, "epochs": 4,
            "learning_rate": 2.5e-4, "decay_learning_rate": True, "clip_epsilon": 0.1,
            "decay_clip_epsilon": True, "entropy_coeff": 0.01, "critic_coeff": 0.5, "gamma": 0.99,
            "gae_lambda": 0.95, "clip_rewards": True, "total_steps": 10_000_000,
            "evaluation_episodes": 100, "initialization": "orthogonal", "warmup_steps": 0,
            "backbone.num_frames": 4,
        }
        for game, env in GAMES.items()
        for network in IMAGE_NETWORKS
    },
    "*/pong*/enhanced-tit-protocol": {"backbone": enhanced_tit(4, **TIT_OF_IMAGES)},
    "ppo/pong/vanilla-tit-protocol": {"backbone": vanilla_tit(4, **TIT_OF_IMAGES)},
    "ppo/pong-flickering/*": {"env": "ALE/Pong-v5", "env_settings": ("blank_probability=0.5",)},
    "ppo/*/catformer-tuned": {
        "backbone": catformer(4, attention_expansion=2, ffn_expansion=4), "initialization": "own",
        "warmup_steps": 200_000,
    },
    "ppo/*/coberl-tuned": {
        "backbone": coberl(4, gate_bias=2.0), "initialization": "own", "warmup_steps": 200_000,
        "contrastive_coeff": 1.0,
    },
    "ppo/*-no-velocity/*": {"hide_velocities": True},
    "ppo/*-no-velocity/*8*": {"backbone.num_frames": 8},
    "ppo/*-no-velocity/enhanced-tit-k8": {"backbone.history.temporal_positions": "learned"},
    "ppo/*-no-velocity/*-no-positions": {"backbone.history.temporal_positions": "none"},
    "ppo/tmaze-*/*": {"env": "TMaze-v0", "entropy_coeff": 0.05},
    # Sequences as long as the corridor; the floor falls with the price of a step.
    "ppo/tmaze-250/*": {"advantage_floor": 25 / 250},
    "ppo/tmaze-500/*": {"advantage_floor": 25 / 500},
    # All settings of algorithms that learn from samples are in test_previous_version.py.
    "cql/*-medium-v0/*": {"conservative_weight": 10.0},
    "cql/*-replay-v0/*": {"conservative_weight": 5.0},
    "dt/halfcheetah-*": {"target_returns": (12000, 6000)},
    "dt/hopper-*": {"target_returns": (3600, 1800)},
    "dt/walker2d-*": {"target_returns": (5000, 2500)},
}  # fmt: skip


def test_every_length_is_an_option_of_train() -> None:
    assert {kind.length for kind in recipe_classes().values()} == set(LENGTHS)


def test_settings() -> None:
    for pattern, expected in SETTINGS.items():
        names = [name for name in RECIPES if fnmatch(name, pattern)]
        assert names, pattern
        for name in names:
            recipe = get_recipe(name)
            found = {field: attrgetter(field)(recipe) for field in expected}
            assert found == expected, name


def test_recipes_of_data_sets() -> None:
    def named(algorithm: str, kinds: str, version: int, networks: str) -> set[str]:
        tasks = ("halfcheetah", "hopper", "walker2d")
        sets = [f"{task}-{kind}-v{version}" for task in tasks for kind in kinds.split()]
        return {f"{algorithm}/{data}/{network}" for data in sets for network in networks.split()}

    both, all_three = "medium medium-replay", "medium medium-replay medium-expert"
    expected = named("cql", both, 0, "mlp enhanced-tit enhanced-tit-paper")
    expected |= named("dt", both, 2, "dt dt-tit dt-tit-paper")
    for algorithm in ("bc", "iql", "td3bc"):
        expected |= named(algorithm, all_three, 2, "mlp enhanced-tit vanilla-tit")
    for algorithm in ("bc", "iql", "td3bc", "cql"):  # for any data
        expected |= {f"{algorithm}/mlp", f"{algorithm}/enhanced-tit"}
    expected |= {"dt/dt", "dt/dt-tit"}
    algorithms = ("cql/", "dt/", "bc/", "iql/", "td3bc/")
    assert {name for name in RECIPES if name.startswith(algorithms)} == expected
    # Those of an algorithm and a network differ in what test_settings says, and CQL's TITs, alone.
    changes: dict[str, Any] = {"name": "", "env": "", "dataset": "hopper-medium-v2"}
    varied: dict[str, Any] = {"cql": {"conservative_weight": 1.0}, "dt": {"target_returns": (1.0,)}}
    alike = set()
    of_data = {name for name in expected if name.count("/") == 2}
    for name in of_data - named("cql", both, 0, "enhanced-tit enhanced-tit-paper"):
        algorithm, _, network = name.split("/")
        one = replace(get_recipe(name), **changes, **varied.get(algorithm, {}))
        alike.add((algorithm, network, one))
    assert len(alike) == 1 + 3 + 3 * 3


def test_all_tasks_and_networks_train_with_one_set_of_settings() -> None:
    """Only the task, the number of steps, what the network reads and the MLP's rate differ."""
    recipes = [
        recipe
        for name, recipe in RECIPES.items()
        if type(recipe) is PPO
        and not name.endswith(PAPERS)
        and name not in PICTURES
        and name not in MEMORIES
    ]
    assert len({recipe.env for recipe in recipes}) == 7  # the paper's
    one = PPO(env="one", backbone=mlp(), **PPO_SETTINGS)
    steady = replace(one, **STEADY_PPO_SETTINGS, hide_velocities=True)
    same: dict[str, Any] = {
        "env": "one", "backbone": mlp(), "total_steps": one.total_steps, "name": "",
    }  # fmt: skip
    faster = replace(one, learning_rate=1e-3)
    assert {replace(recipe, **same) for recipe in recipes} == {one, faster, steady}
    found = {recipe.backbone for recipe in recipes if replace(recipe, **same) == faster}
    assert found == {mlp()}


def test_all_pictures_train_with_one_set_of_settings() -> None:
    """But for TIT's on MinAtar, which reads pixels as they are.

    Nothing in it depends on the number of steps, so a short run begins as a long one.
    """
    recipes: list[Any] = [get_recipe(n) for n in PICTURES if not n.endswith(PAPERS)]
    assert len({recipe.env for recipe in recipes}) == 4 + 5
    one = PPO(env="one", backbone=mlp(), **PICTURE_SETTINGS)
    same: dict[str, Any] = {
        "env": "one", "env_settings": (), "backbone": mlp(), "total_steps": one.total_steps,
        "name": "", "image_layout": "auto",
    }  # fmt: skip
    raw = [recipe for recipe in recipes if not recipe.normalize_observations]
    tit = [name for name in PICTURES if name.startswith("ppo/minatar") and "tit" in name]
    assert sorted(recipe.name for recipe in raw) == sorted(tit)
    same["normalize_observations"] = True
    assert {replace(recipe, **same) for recipe in recipes} == {one}
    assert not one.schedules
    assert not one.warmup_steps


TASKS_OF_MEMORY = sorted({name.rpartition("/")[0] for name in MEMORIES})


@pytest.mark.parametrize("task", TASKS_OF_MEMORY)
def test_recipes_of_memory_differ_in_the_memory_alone(task: str) -> None:
    pytest.importorskip("minigrid")
    pytest.importorskip("popgym")
    recipes = [get_recipe(name) for name in MEMORIES if name.startswith(f"{task}/")]
    frames: set[Any] = {recipe.backbone.frame for recipe in recipes}
    assert all(isinstance(frame, Inner) for frame in frames)
    assert len({replace(frame, every_block=False) for frame in frames}) == 1
    first, sizes = recipes[0], []
    for recipe in recipes:
        assert isinstance(recipe, PPO)
        assert replace(recipe, name=first.name, backbone=first.backbone) == first
        algorithm = make_algorithm(recipe)
        algorithm.check()
        sizes.append(sum(weights.numel() for weights in algorithm.policy.parameters()))
        if "tmaze" in task:  # the cue is within reach of those that should solve it
            length = int(task.rpartition("-")[2])
            reaches = recipe.backbone.num_frames > length or recipe.backbone.carries_state
            assert reaches == ("frames" not in recipe.name)
            assert recipe.steps_per_sequence > length
    assert max(sizes) < 1.1 * min(sizes), "about the same number of weights"


@pytest.mark.parametrize(
    "name",
    [f"ppo/{name}/enhanced-tit" for name in ("ant", "cartpole", "memory-s7")]
    + [f"ppo/pong/{network}" for network in ("resnet", "enhanced-tit-wo-outer", "coberl-tuned")]
    + [f"ppo/minatar-asterix/{network}" for network in ("minatar-cnn", "enhanced-tit")]
    + ["ppo/pong-flickering/enhanced-tit-k16"]
    + ["sac/hopper/mlp", "odt/hopper-medium-replay-v2/odt-small"],
)
def test_networks_fit_their_tasks(name: str) -> None:
    """All of them are built in the slow test below."""
    pytest.importorskip("ale_py")
    pytest.importorskip("minigrid")
    if "minatar" in name:
        pytest.importorskip("minatar")
    algorithm = make_algorithm(get_recipe(name))
    algorithm.check()
    if name.startswith("ppo/") and name not in PICTURES:
        (frames,) = algorithm.policy[0].module.frames
        patches = frames.encoder.patch_embedding.num_patches
        assert patches == (3 * 3 if "memory" in name else 1)  # a tile; the whole array


@pytest.mark.slow
def test_every_named_recipe_builds_its_agent():
    built = set()
    for name, recipe in RECIPES.items():
        # Recipes of Atari games differ in the game alone.
        if recipe.env.startswith("ALE/") and "pong" not in name and "nature-cnn" not in name:
            continue
        if recipe.env.startswith("MinAtar/") and find_spec("minatar") is None:
            continue
        if isinstance(recipe, DatasetRecipe) and recipe.dataset in D4RL_DATASETS:  # not read here
            alike = replace(recipe, name="", dataset="hopper-medium-v2")
            if alike in built:
                continue
            built.add(alike)
        if isinstance(recipe, DatasetRecipe) and not recipe.dataset:
            with pytest.raises(ValueError, match="is a recipe for any data"):
                make_algorithm(recipe)
        elif name.startswith("discrete-cql/"):  # on data that its user collects
            with pytest.raises(FileNotFoundError, match=r"no data file data/.*create it first"):
                make_algorithm(recipe).check()
        else:
            make_algorithm(recipe).check()
