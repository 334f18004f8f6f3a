"""Behavior cloning, IQL and TD3+BC on D4RL's sets of version 2, as in the last two's papers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit, mlp, vanilla_tit

from .preset import BC, IQL, TD3BC, Preset

# D4RL's data are from v2 of the tasks; v4 is closer to it than v5.
_TASKS = {"halfcheetah": "HalfCheetah-v4", "hopper": "Hopper-v4", "walker2d": "Walker2d-v4"}
_KINDS = ("medium", "medium-replay", "medium-expert")
# The MLP of the papers of IQL and TD3+BC. For TIT the whole observation is one patch, as in the
# paper's CQL; the sizes are those of its CQL on hopper-medium and walker2d-medium.
_TIT: dict[str, Any] = {
    "patch_size": None,
    "num_blocks": 1,
    "num_heads_outer": 2,
    "ffn_expansion_inner": 1,
    "ffn_expansion_outer": 1,
    "position_encoding": False,
    "features_dim": 512,
    "activation_head": "relu",
}
_NETWORKS: dict[str, Network] = {
    "mlp": mlp(hidden_dim=256, activation="relu"),
    "enhanced-tit": enhanced_tit(**_TIT),
    "vanilla-tit": vanilla_tit(**_TIT),
}


def _named() -> Iterator[Preset]:
    for task, env in _TASKS.items():
        for data in (f"{task}-{kind}-v2" for kind in _KINDS):
            for network, backbone in _NETWORKS.items():
                fields: dict[str, Any] = {"dataset": data, "env": env, "backbone": backbone}
                name = f"{data}/{network}"
                yield BC(name=f"bc/{name}", **fields)
                yield IQL(name=f"iql/{name}", **fields)
                yield TD3BC(name=f"td3bc/{name}", **fields)


RECIPES: list[Preset] = [*_named()]
"""``bc/DATASET/NETWORK``, ``iql/DATASET/NETWORK`` and ``td3bc/DATASET/NETWORK``."""
