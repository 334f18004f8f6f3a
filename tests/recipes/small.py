"""Small recipes of all algorithms, on tasks and on random rollouts, and their runs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from recipes.bc import BC
from recipes.coberl import ContrastivePPO
from recipes.core import algorithm, runner
from recipes.core.callback import Callback
from recipes.core.metrics import read_metrics
from recipes.core.recipe import Recipe
from recipes.core.run import Run
from recipes.cql import CQL, DiscreteCQL
from recipes.decision_transformer import DT
from recipes.dqn import DQN
from recipes.gsde import SmoothPPO
from recipes.iql import IQL
from recipes.novelty import NovelPPO
from recipes.online_decision_transformer import ODT
from recipes.ppo import PPO
from recipes.sac import SAC
from recipes.td3bc import TD3BC
from tests.datasets.rollouts import roll, write
from tests.recipes.states import TIMES, assert_same
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint
from torchrl_tit.settings import CoBERL, HistorySettings, Inner, Network
from torchrl_tit.settings.networks import decision_transformer, dt_tit, enhanced_tit, lstm, mlp

_roll = cache(roll)


def make_data(folder: Path) -> Path:
    return write(folder / "hopper.hdf5", _roll())


def make_cartpole_data(folder: Path) -> Path:
    return write(folder / "cartpole.hdf5", _roll(task="CartPole-v1", max_episode_steps=20))


def tit(num_frames: int = 1, **hyperparameters: Any) -> Network:
    small: dict[str, Any] = {
        "embed_dim": 8,
        "features_dim": 8,
        "attention_dropout_outer": 0.1,
        "ffn_dropout_inner": 0.2,
    }
    return enhanced_tit(num_frames, **{**small, **hyperparameters})


SMALL = mlp(hidden_dim=8, activation="relu")
COBERL = Network(
    frame=Inner(embed_dim=8), history=CoBERL(num_blocks=1, num_heads=2, hidden_dim=8), num_frames=3
)
SMALL_DT: dict[str, Any] = {"num_frames": 6, "embed_dim": 16, "num_blocks": 2}
_INTERVALS = {
    "batch_size": 8,
    "evaluation_episodes": 3,
    "log_interval": 5,
    "checkpoint_interval": 4,
}
_OF_KIND: dict[Any, dict[str, Any]] = {
    CQL: {"backbone": tit(), "critic_hidden": (16, 16)},
    DiscreteCQL: {"backbone": tit(), "env": "CartPole-v1"},
    BC: {"backbone": SMALL},
    IQL: {"backbone": SMALL, "critic_hidden": (16,)},
    TD3BC: {"backbone": SMALL, "critic_hidden": (16,)},
}
SETTINGS: dict[str, Any] = {**_INTERVALS, "total_updates": 18, "evaluation_interval": 9}
_SEQUENCES: dict[str, Any] = {
    **_INTERVALS,
    "target_returns": (40.0, 10.0),
    "learning_rate": 1e-3,
    "warmup_updates": 4,
}


def make(kind: type[Recipe], folder: Path, **settings: Any) -> Any:
    """A recipe that draws transitions of Hopper, or of CartPole where that is named."""
    fields = {"env": "Hopper-v5", **SETTINGS, **_OF_KIND[kind], **settings}
    if "dataset" not in fields:
        discrete = fields["env"] == "CartPole-v1" and kind is not CQL
        fields["dataset"] = str((make_cartpole_data if discrete else make_data)(folder))
    return kind(**{"name": f"{kind.algorithm}/small", **fields})


make_cql = partial(make, CQL)


def make_discrete_cql(folder: Path, **settings: Any) -> DiscreteCQL:
    return make(DiscreteCQL, folder, **{"dataset": str(make_cartpole_data(folder)), **settings})


def make_dt(folder: Path, **settings: Any) -> DT:
    fields = {
        "name": "dt/hopper/small",
        "env": "Hopper-v5",
        "dataset": str(make_data(folder)),
        "backbone": dt_tit(**SMALL_DT),
        "iterations": 2,
        "updates_per_iteration": 9,
    }
    return DT(**{**_SEQUENCES, **fields, **settings})


def make_odt(folder: Path, **settings: Any) -> ODT:
    fields = {
        "name": "odt/hopper/small",
        "env": "Hopper-v5",
        "dataset": str(make_data(folder)),
        "backbone": dt_tit(**SMALL_DT, timestep_embedding=False),
        "acting_num_frames": 3,
        "online_return": 60.0,
        "pretraining_updates": 6,
        "rounds": 3,
        "updates_per_round": 4,
        "capacity": 5,
        "evaluation_interval": 2,
    }
    return ODT(**{**_SEQUENCES, **fields, **settings})


def make_cartpole_dt(folder: Path, **settings: Any) -> DT:
    fields = {
        "dataset": str(make_cartpole_data(folder)),
        "env": "CartPole-v1",
        "backbone": decision_transformer(**SMALL_DT),
        "action_space": "discrete",
        "target_returns": (20.0,),
    }
    return make_dt(folder, **{**fields, **settings})


def make_algorithm(recipe: Recipe) -> Any:
    """The algorithm, as Any: it has more than what all algorithms have."""
    return algorithm.make_algorithm(recipe)


def double(recipe: Recipe, folder: Path) -> tuple[Any, TensorDictBase]:
    """An algorithm in float64, ready for updates, and a batch."""
    torch.manual_seed(0)
    made = make_algorithm(recipe)
    made.model.double()
    made.prepare(0, folder)
    batch = made.buffer.sample()
    return made, batch.apply(lambda x: x.double() if x.is_floating_point() else x)


_SHORT: dict[str, Any] = {"env_settings": ("max_episode_steps=20",)}
_ONLINE: dict[str, Any] = {
    "backbone": tit(3),
    "name": "small",
    "evaluation_episodes": 2,
    **_SHORT,
}
_ROLLOUTS: dict[str, Any] = {
    **_ONLINE,
    "total_steps": 96,
    "steps_per_batch": 32,
    "minibatch_size": 16,
    "epochs": 2,
    "normalize_observations": True,
}
_REPLAY: dict[str, Any] = {
    **_ONLINE,
    "total_steps": 60,
    "steps_per_batch": 20,
    "random_steps": 20,
    "updates_per_step": 0.25,
    "log_interval": 20,
    "normalize_observations": True,
}
_NORMALIZED: dict[str, Any] = {**_SHORT, "backbone": tit(3), "normalize_observations": True}
_CRITIC: dict[str, Any] = {**_NORMALIZED, "critic": "backbone", "total_updates": 9}


def _carries(history: str) -> dict[str, Any]:
    """A network that carries a state, and the slices from which it learns."""
    network = lstm(embed_dim=8, hidden_dim=8, features_dim=8)
    backbone = replace(network, history=HistorySettings.get(history)())
    return {"backbone": backbone, "slice_length": 4, "burn_in": 3, "batch_size": 16}


TINY = PPO(
    name="ppo/cartpole/mlp",
    env="CartPole-v1",
    backbone=mlp(hidden_dim=8),
    total_steps=128,
    steps_per_batch=64,
    minibatch_size=32,
    epochs=1,
    checkpoint_interval=64,
    evaluation_episodes=2,
)

RECIPES: dict[str, Callable[[Path], Recipe]] = {
    "ppo": lambda folder: PPO(env="CartPole-v1", **_ROLLOUTS),
    "ppo, continuous": lambda folder: PPO(env="Pendulum-v1", **_ROLLOUTS),
    "ppo, contrastive": lambda folder: ContrastivePPO(
        env="CartPole-v1", **{**_ROLLOUTS, "backbone": COBERL}
    ),
    "ppo, novelty": lambda folder: NovelPPO(env="CartPole-v1", **_ROLLOUTS),
    "ppo, smooth": lambda folder: SmoothPPO(env="Pendulum-v1", **_ROLLOUTS),
    "sac": lambda folder: SAC(env="Pendulum-v1", **_REPLAY),
    "dqn": lambda folder: DQN(env="CartPole-v1", **_REPLAY),
    "dqn, lstm": lambda folder: DQN(env="CartPole-v1", **_REPLAY | _carries("lstm")),
    "sac, mamba2": lambda folder: SAC(env="Pendulum-v1", **_REPLAY | _carries("mamba2")),
    "iql, gru": partial(make, IQL, **_CRITIC | _carries("gru")),
    "cql, mingru": partial(make, CQL, cloning_updates=5, **_CRITIC | _carries("mingru")),
    "bc": partial(make, BC, **_NORMALIZED),
    "bc, discrete": partial(make, BC, env="CartPole-v1", **_NORMALIZED),
    "iql": partial(make, IQL, **_CRITIC),
    "iql, discrete": partial(make, IQL, env="CartPole-v1", normalize_rewards=True, **_NORMALIZED),
    "td3bc": partial(make, TD3BC, **_CRITIC),
    "cql": partial(make, CQL, over_critics="sum", cloning_updates=5, **_CRITIC),
    "discrete-cql": partial(make_discrete_cql, **_NORMALIZED),
    "dt": partial(make_dt, **_SHORT),
    "dt, discrete": partial(make_cartpole_dt, **_SHORT),
    "odt": partial(make_odt, **_SHORT),
}
"""Makes a small recipe of each algorithm, with the data that it needs in a folder."""


class Batches(Callback):
    """Keeps the collected batches, and may end the training at a step."""

    def __init__(self, last: int | None = None) -> None:
        self.last = last
        self.batches: list[Any] = []

    def collected(self, step: int, batch: Any) -> None:
        self.batches.append(batch.clone())

    def updated(self, step: int, policy: Any) -> bool:
        return self.last is not None and step >= self.last


def train(recipe: Recipe, folder: Path, *callbacks: Callback) -> Run:
    """Trains in a run folder, new or not."""
    run = Run(folder, recipe) if folder.exists() else Run.create(folder, recipe)
    with run:
        runner.train(recipe, run, callbacks)
    return run


def assert_resumes_bit_for_bit(whole: Run, folder: Path) -> None:
    """Resumes from the last checkpoint but one, which lies within an interval of metrics."""
    shutil.copytree(whole.folder, folder)
    recipe = whole.recipe
    with Run.open(folder) as run:
        *_, before, last = checkpoint_steps(run.checkpoints)
        assert last == recipe.final_step
        assert before % recipe.log_interval
        shutil.rmtree(run.checkpoints / f"{last:012d}")
        torch.manual_seed(123)  # the resuming process may be in any state
        runner.train(recipe, run)
    assert_same_run(run, whole)


def assert_same_run(run: Run, other: Run) -> None:
    """Compares everything in the newest checkpoints, and all metrics but the time."""
    assert_same(load_checkpoint(run.checkpoints), load_checkpoint(other.checkpoints))
    rows, expected = (
        [
            {name: str(value) for name, value in row.items() if name not in TIMES}
            for row in read_metrics(one.folder / "metrics.csv")
        ]
        for one in (run, other)
    )
    assert rows == expected
