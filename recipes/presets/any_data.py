"""The named recipes for data of your own, which ``--dataset`` names, with or without ``--env``."""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import decision_transformer, dt_tit, mlp

from .ppo_settings import reliable_tit
from .preset import BC, CQL, DT, IQL, TD3BC, DiscreteCQL, Preset, of_networks

_NETWORKS: dict[str, Network] = {
    "mlp": mlp(hidden_dim=256, activation="relu"),
    "enhanced-tit": reliable_tit("enhanced-tit", 4),
}
# Sensors have any scale, and data of one machine are few.
_SETTINGS: dict[str, Any] = {
    "dataset": "",
    "normalize_observations": True,
    "total_updates": 50_000,
    "evaluation_interval": 1000,
}
# With these, an update of CQL takes a fifth of the time, and values spread through time within some
# thousand updates. The conservative weight must grow with the values: 5 shifts a value by 1.25 at
# most where the data are, which is little beside 200. At a temperature of 1, entropy outweighs the
# likelihood of what the actor clones.
_CQL: dict[str, Any] = {
    "actor_learning_rate": 3e-4,
    "action_samples": 4,
    "critic_hidden": (256, 256),
    "temperature_learning_rate": 1e-3,
    "alpha_init": 0.01,
    "tau": 0.02,
    "conservative_weight": 100.0,
    "cloning_updates": 5000,
}
_DT: dict[str, Any] = {
    "dataset": "",
    "iterations": 20,
    "updates_per_iteration": 500,
    "learning_rate": 3e-4,
    "warmup_updates": 1000,
}

RECIPES: list[Preset] = [
    *of_networks(BC, "bc", _NETWORKS, **_SETTINGS),
    *of_networks(IQL, "iql", _NETWORKS, **_SETTINGS),
    *of_networks(TD3BC, "td3bc", _NETWORKS, **_SETTINGS),
    *of_networks(CQL, "cql", _NETWORKS, **_SETTINGS, **_CQL),
    *of_networks(DiscreteCQL, "discrete-cql", _NETWORKS, **_SETTINGS),
    *of_networks(DT, "dt", {"dt": decision_transformer(), "dt-tit": dt_tit()}, **_DT),
]
"""``ALGORITHM/mlp`` and ``ALGORITHM/enhanced-tit``, ``dt/dt`` and ``dt/dt-tit``."""
