"""Settings, tasks and data that do not fit: refused before anything runs, in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, MultiDiscrete

from recipes.core.algorithm import make_algorithm
from recipes.core.recipe import Recipe
from recipes.core.registry import get_recipe
from recipes.cql import CQL, DiscreteCQL
from recipes.dqn import DQN
from recipes.iql import IQL
from recipes.ppo import PPO, PPOAlgorithm
from recipes.sac import SAC
from recipes.td3bc import TD3BC
from tests.datasets.rollouts import roll, write
from tests.recipes.small import (
    BC,
    SMALL,
    TINY,
    make,
    make_cartpole_data,
    make_cql,
    make_data,
    make_discrete_cql,
    make_dt,
    make_odt,
    tit,
)
from torchrl_tit.settings.networks import (
    coberl,
    decision_transformer,
    enhanced_tit,
    lstm,
    mlp,
    nature_cnn,
)

SPLIT = "tests.recipes.ppo.tasks:Split"


class Endless(gymnasium.Env):
    """Actions have no upper bounds, or there are several."""

    observation_space = Box(-1, 1, (3,))

    def __init__(self, several: bool = False) -> None:
        several_actions, one = MultiDiscrete([2, 3]), Box(0, np.inf, (2,))
        self.action_space = several_actions if several else one


gymnasium.register("EndlessActions-v0", f"{__name__}:Endless")
gymnasium.register("SeveralActions-v0", f"{__name__}:Endless", kwargs={"several": True})

PPO_RECIPE = replace(TINY, backbone=enhanced_tit(2, embed_dim=8, features_dim=8), num_envs=4)
RECURRENT = {"backbone": lstm(embed_dim=8), "num_envs": 2}
COLLECTORS = {"collectors": 2}
REPLAY: dict[str, Any] = {"backbone": SMALL, "random_steps": 20, "steps_per_batch": 10}
SAC_RECIPE = SAC(env="Pendulum-v1", critic_hidden=(16,), batch_size=8, **REPLAY)
DQN_RECIPE = DQN(env="CartPole-v1", batch_size=8, **REPLAY)
ONE_STEP = "lstm carries a state and learns from sequences, but slice_length is 1"
BOUNDED = r"needs continuous actions within bounds, but those of .*\(.*shape=\[2\].*\)"

REFUSED: list[tuple[Recipe, dict[str, Any], str]] = [
    (PPO_RECIPE, {**COLLECTORS, "num_envs": 3, "steps_per_batch": 63}, "collectors 2 does not div"),
    (PPO_RECIPE, {"collectors": 0}, "collectors must be at least 1"),
    (PPO_RECIPE, {**COLLECTORS, "ray": ""}, "ray is empty"),
    (PPO_RECIPE, {**COLLECTORS, "ray": "ray://head:10001"}, "start it on a machine of the cluster"),
    (PPO_RECIPE, {**RECURRENT, "sequence_length": 5}, "sequence_length 5 does not divide minibat"),
    (
        PPO_RECIPE,
        {**RECURRENT, "sequence_length": 32, "steps_per_batch": 80},
        "steps_per_batch / num_envs 40",
    ),
    (PPO_RECIPE, {**RECURRENT, "sequence_length": 0}, "sequence_length must be at least 1"),
    (get_recipe("ppo/pong/coberl-tuned"), {"backbone": mlp()}, "only coberl predicts, not mlp"),
    (PPO_RECIPE, {"backbone": nature_cnn()}, "image"),
    (PPO_RECIPE, {"backbone": coberl(4)}, "do not read an array"),
    (PPO_RECIPE, {"backbone": enhanced_tit(num_heads_outer=5)}, "heads"),
    (PPO_RECIPE, {"mask_actions": True}, "no mask of its actions"),
    (PPO_RECIPE, {"env_settings": ("num_frames=3",)}, "num_frames is none: it is a field of the r"),
    (PPO_RECIPE, {"env_settings": ("render_mode=human",)}, "render_mode is none: .* or command"),
    (PPO_RECIPE, {"env_settings": ("depth=3",)}, "cannot be made: TypeError: .*'depth'"),
    (PPO_RECIPE, {"backbone": decision_transformer()}, "reads actions and returns .* use a dt"),
    (
        SAC_RECIPE,
        {"collectors": 2, "num_envs": 4, "steps_per_batch": 20},
        "collectors is 2, but sac collects in one process",
    ),
    (
        SAC_RECIPE,
        {"collectors": 3, "num_envs": 4, "steps_per_batch": 20, "ray": "auto"},
        "collectors 3 does not divide num_envs 4",
    ),
    (SAC_RECIPE, {"random_steps": 25}, "steps_per_batch 10 does not divide random_steps 25"),
    (SAC_RECIPE, {"slice_length": 3}, "slice_length 3 does not divide batch_size 8"),
    (
        SAC_RECIPE,
        {"slice_length": 8, "random_steps": 10, "num_envs": 2},
        "slice_length 8 is longer than",
    ),
    (SAC_RECIPE, {"backbone": lstm()}, f"{ONE_STEP}.* or backbone.num_frames to 2 or more"),
    (SAC_RECIPE, {"burn_in": 4, "slice_length": 2}, "burn_in is 4, but mlp carries no state"),
    (
        SAC_RECIPE,
        {"backbone": lstm(), "slice_length": 4, "burn_in": 17},
        "slice_length 4 and burn_in 17 are longer than the 20 random_steps of 1 env",
    ),
    (
        SAC_RECIPE,
        {"env": "CartPole-v1"},
        "sac needs .*, but those of CartPole-v1 are .*: use a ppo recipe",
    ),
    (SAC_RECIPE, {"env": "EndlessActions-v0"}, f"sac {BOUNDED}"),
    (
        SAC_RECIPE,
        {"wrappers": (SPLIT,), "critic": "mlp", "backbone": tit()},
        r"an MLP cannot value several observations \(cart, pole\): set critic to 'backbone'",
    ),
    (DQN_RECIPE, {"env": "Pendulum-v1"}, "dqn needs a few discrete actions, but those of Pendulum"),
    (
        DQN_RECIPE,
        {"env": "SeveralActions-v0"},
        r"dqn needs a few discrete .* MultiCategorical\(shape=\[2\].*: use a ppo",
    ),
    (
        SAC_RECIPE,
        {"wrappers": ("gymnasium.wrappers:NormalizeObservation",)},
        "which neither evaluations .* would have: use the field normalize_observations instead",
    ),
    (
        DQN_RECIPE,
        {"wrappers": ("gymnasium.wrappers:TransformReward(func=1)",)},
        r"\['gymnasium.wrappers:TransformReward\(func=1\)'\] do not fit CartPole-v1: 'int' object",
    ),
    (
        DQN_RECIPE,
        {"wrappers": ("torchrl.envs:FlattenObservation(first_dim=-2, last_dim=-1)",)},
        "do not fit CartPole-v1: .*'pixels' not found",
    ),
    (DQN_RECIPE, {"updates_per_step": 0.05}, "times steps_per_batch 10 is 0.5 gradient steps: mak"),
    (DQN_RECIPE, {"updates_per_step": 0.25}, "0.25 times steps_per_batch 10 is 2.5 gradient steps"),
    (DQN_RECIPE, {"buffer_size": 5}, "buffer_size 5 has no room for a batch of 10 steps"),
]


@pytest.mark.parametrize(("recipe", "fields", "message"), REFUSED)
def test_of_recipes_that_act(recipe, fields, message):
    with pytest.raises((ValueError, TypeError), match=message) as error:
        make_algorithm(replace(recipe, **fields)).check()
    assert "\n" not in str(error.value)


ON_DATA: list[tuple[Any, dict[str, Any], str]] = [
    (CQL, {"env": "CartPole-v1"}, "cql needs continuous actions within bounds, but those of CartP"),
    (CQL, {"env": "ALE/Pong-v5"}, "those of ALE/Pong-v5 are Categorical"),
    (CQL, {"env": "Hoper-v5"}, "did you mean Hopper-v5"),
    (CQL, {"env": "Walker2d-v5"}, r"\[11\], but in Walker2d-v5 it is \[17\]"),
    (CQL, {"dataset": "hopper"}, "'hopper' is not a data set: give an HDF5 file"),
    (CQL, {"dataset": "./no.hdf5"}, r"no\.hdf5"),
    (CQL, {"backbone": nature_cnn()}, r"\(11,\) is that of an array, but this encoder reads imag"),
    (CQL, {"slice_length": 2, "compile": "on"}, "compile is on, but slices of 2 are not compiled"),
    (CQL, {"total_updates": 9, "cloning_updates": 9}, "so an actor of 9 updates .* only imitates"),
    (CQL, {"gamma": float("nan")}, "gamma must be at least 0, not nan"),
    (CQL, {"tau": -0.1}, r"tau must be at least 0, not -0\.1"),
    (CQL, {"critic_hidden": (8, 0)}, r"critic_hidden must be at least one width .*, not \(8, 0\)"),
    (CQL, {"over_critics": "max"}, r"'over_critics' is 'max', not one of \('mean', 'sum'\)"),
    (DiscreteCQL, {"env": "Hopper-v5"}, "discrete-cql needs a few discrete actions, but those of"),
    (
        TD3BC,
        {"env": "CartPole-v1"},
        "td3bc needs continuous actions .* CartPole-v1 are Categorical",
    ),
    (TD3BC, {"env": "EndlessActions-v0"}, f"td3bc {BOUNDED}"),
    (BC, {"env": "FrozenLake-v1", "normalize_observations": True}, "int64, not floats: switch"),
    (IQL, {"env": "Blackjack-v1"}, "data sets hold one observation, but .* has several"),
    (IQL, {"expectile": 1.0}, r"expectile must be a probability in \(0, 1\), not 1.0"),
    (make_dt, {"acting_num_frames": 7}, "acting_num_frames must be at most 6, not 7"),
    (make_dt, {"target_returns": (1234567.0, 1234568.0)}, "must differ within six digits, unlike"),
    (make_dt, {"backbone": mlp()}, "backbone.history is mlp, but this recipe trains a decision-t"),
    (make_dt, {"action_space": "gaussian"}, "'gaussian', which this loss cannot train"),
    (
        make_dt,
        {"backbone": decision_transformer(max_ep_len=999)},
        "episodes of Hopper-v5 have up to 1000 steps, but max_ep_len is 999",
    ),
    (make_dt, {"action_space": "discrete"}, "Hopper-v5 has continuous actions, but the head's are"),
    (make_dt, {"env": "CartPole-v1"}, "CartPole-v1 has discrete actions, but the head's are cont"),
    (make_dt, {"env": "Pendulum-v1"}, "actions of Pendulum-v1 range from -2 to 2, but the head's"),
    (make_dt, {"env": "Walker2d-v5"}, "observations"),
    (make_odt, {"action_space": "continuous"}, "'continuous', but exploration needs a d"),
]


def check_on_data(kind, folder, fields):
    recipe = make(kind, folder, **fields) if isinstance(kind, type) else kind(folder, **fields)
    make_algorithm(recipe).check()


@pytest.mark.parametrize(("kind", "fields", "message"), ON_DATA)
def test_of_recipes_on_data(kind, fields, message, tmp_path):
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        check_on_data(kind, tmp_path, fields)
    assert "\n" not in str(error.value)


def test_data_of_another_task(tmp_path: Path) -> None:
    for recipe in (
        make_discrete_cql(tmp_path, dataset=str(make_data(tmp_path))),
        make_cql(tmp_path, dataset=str(make_cartpole_data(tmp_path))),
    ):
        with pytest.raises(ValueError, match="another task"):
            make_algorithm(recipe).check()


@pytest.mark.parametrize(
    ("make_recipe", "task", "message"),
    [
        (make_discrete_cql, "CartPole-v1", "are floats, but those of CartPole-v1 are integers"),
        (make_cql, "Hopper-v5", "are integers, but those of Hopper-v5 are floats: use other data"),
    ],
)
def test_actions_of_the_right_shape_but_the_other_kind(make_recipe, task, message, tmp_path):
    rolled = roll(task=task, max_episode_steps=20)
    if task == "CartPole-v1":
        rolled["actions"] = rolled["actions"][:, None] * np.float32(0.5)
    else:
        rolled["actions"] = np.sign(rolled["actions"]).astype(np.int64)
    data = str(write(tmp_path / "others.hdf5", rolled))
    with pytest.raises(ValueError, match=message):
        make_algorithm(make_recipe(tmp_path, dataset=data)).check()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"env": "ALE/Pongg-v5"}, "Unknown task 'ALE/Pongg-v5'; did you mean"),
        ({"backbone": replace(nature_cnn(4), frame=enhanced_tit(patch_size=12).frame)}, "flat"),
        ({"hide_velocities": True}, "velocities"),
    ],
)
def test_of_games(fields, message):
    pytest.importorskip("ale_py")
    with pytest.raises(ValueError, match=message):
        make_algorithm(replace(get_recipe("ppo/pong/nature-cnn"), **fields)).check()


def test_networks_that_fit_after_all() -> None:
    replace(SAC_RECIPE, backbone=lstm(2))
    replace(PPO_RECIPE, sequence_length=5, backbone=mlp())  # which has no use for it
    with pytest.raises(ValueError, match="num_frames"):
        enhanced_tit(1, temporal_positions="learned")


class Loose(PPOAlgorithm):
    def networks(self, env):
        self.predictor = torch.nn.Linear(4, 2)
        return super().networks(env)


def test_weights_that_would_be_neither_trained_nor_saved(monkeypatch) -> None:
    monkeypatch.setattr(PPO, "build", lambda recipe: Loose(recipe))
    with pytest.raises(ValueError, match=r"Loose\.predictor has weights that are neither"):
        make_algorithm(PPO_RECIPE)
    monkeypatch.setattr(Loose, "networks", PPOAlgorithm.networks)
    make_algorithm(PPO_RECIPE)
