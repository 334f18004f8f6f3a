"""The paper's runs of CQL and CQL_TIT, and runs on data that `data collect` makes."""

from __future__ import annotations

from torchrl_tit.settings import Network
from torchrl_tit.settings.encoders import Activation
from torchrl_tit.settings.networks import enhanced_tit, mlp, nature_cnn

from .ppo_atari import TIT_PROTOCOL
from .preset import CQL, DiscreteCQL, Preset, of_networks

# Task name: environment and entries of an observation. The paper evaluated in D4RL's own
# environments, MuJoCo's v2; v4 is closest to it.
_TASKS = {
    "halfcheetah": ("HalfCheetah-v4", 17),
    "hopper": ("Hopper-v4", 11),
    "walker2d": ("Walker2d-v4", 17),
}

# What the authors of arXiv 2212.14538 released: embed_dim, num_blocks, features_dim,
# num_heads_outer, attention and FFN dropout of the outer blocks, head, expansion, shared blocks.
_TIT: dict[str, tuple[int, int, int, int, float, float, Activation, int, bool]] = {
    "halfcheetah-medium": (256, 2, 512, 4, 0.0, 0.1, "gelu", 1, False),
    "hopper-medium": (32, 1, 512, 2, 0.0, 0.0, "relu", 1, True),
    "walker2d-medium": (32, 1, 512, 2, 0.0, 0.0, "relu", 1, True),
    "halfcheetah-medium-replay": (128, 2, 1024, 2, 0.0, 0.0, "tanh", 1, True),
    "hopper-medium-replay": (128, 2, 1024, 1, 0.1, 0.0, "relu", 1, True),
    "walker2d-medium-replay": (32, 2, 512, 2, 0.0, 0.0, "relu", 2, True),
}


def _tit(dataset: str, observation_dim: int, position_encoding: bool = False) -> Network:
    width, blocks, features, heads, attention, ffn, head, expansion, shared = _TIT[dataset]
    return enhanced_tit(
        patch_size=observation_dim,
        embed_dim=width,
        num_blocks=blocks,
        num_heads_outer=heads,
        ffn_expansion_inner=1,
        ffn_expansion_outer=expansion,
        attention_dropout_outer=attention,
        ffn_dropout_outer=ffn,
        position_encoding=position_encoding,
        share_blocks=shared,
        features_dim=features,
        activation_head=head,
    )


def _continuous() -> list[Preset]:
    recipes = []
    for task, (env, observation_dim) in _TASKS.items():
        for data in (f"{task}-medium", f"{task}-medium-replay"):
            networks = {
                "mlp": mlp(hidden_dim=256, num_layers=3, activation="relu"),
                "enhanced-tit": _tit(data, observation_dim),
                # The paper has one table of sizes, which are the released ones of this data set,
                # and always encodes positions.
                "enhanced-tit-paper": _tit("halfcheetah-medium", observation_dim, True),
            }
            recipes += of_networks(
                CQL,
                f"cql/{data}-v0",
                networks,
                dataset=f"{data}-v0",
                env=env,
                conservative_weight=5.0 if data.endswith("replay") else 10.0,
            )
    return recipes


def _discrete() -> list[Preset]:
    """The paper ran no discrete task offline; the data are those of docs/datasets.md."""
    cartpole = of_networks(
        DiscreteCQL,
        "discrete-cql/cartpole-mixed",
        {"mlp": mlp(activation="relu"), "enhanced-tit": enhanced_tit(patch_size=2)},
        dataset="data/cartpole/mixed.hdf5",
        env="CartPole-v1",
        batch_size=64,
        total_updates=10_000,
        evaluation_episodes=20,
    )
    pong = of_networks(
        DiscreteCQL,
        "discrete-cql/pong-mixed",
        {"nature-cnn": nature_cnn(4), "enhanced-tit": TIT_PROTOCOL["enhanced-tit"]},
        dataset="data/pong/mixed.hdf5",
        env="ALE/Pong-v5",
        padding="constant",
        batch_size=32,
        learning_rate=1e-4,
        total_updates=20_000,
        evaluation_interval=4_000,
        evaluation_episodes=5,
    )
    return cartpole + pong


RECIPES: list[Preset] = [*_discrete(), *_continuous()]
"""``cql/DATASET/mlp``, ``enhanced-tit`` (the authors' code) and ``enhanced-tit-paper`` (the paper's
table) for D4RL's data of version 0, and ``discrete-cql/...`` for collected data."""
