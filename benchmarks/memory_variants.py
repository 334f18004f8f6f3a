"""Variants of memory recipes to compare: ``benchmarks/memory_variants.py:ppo/tmaze-50/gru``.

Each differs from a named recipe in what its name says, and every command that takes a recipe takes
it. docs/results/memory.md has the results.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from recipes.core.registry import get_recipe
from recipes.ppo import PPO
from recipes.presets.ppo_memory import VIEW
from torchrl_tit.settings import GRU, Inner, Network, Outer
from torchrl_tit.settings.encoders import ChainedOuter, PairedOuter


def _variant(recipe: str, name: str, network: dict[str, Any] | None = None, **fields: Any) -> PPO:
    """Returns a recipe with other settings of its network, and other fields."""
    named = get_recipe(recipe)
    assert isinstance(named, PPO)
    assert isinstance(named.backbone, Network)
    task = recipe.rpartition("/")[0]
    backbone = replace(named.backbone, **network or {})
    return replace(named, name=f"{task}/{name}", backbone=backbone, **fields)


_T_MAZE, _S7 = "ppo/tmaze-50", "ppo/memory-s7"
_ROTARY: dict[str, Any] = {"temporal_positions": "rotary"}

RECIPES: dict[str, PPO] = {
    recipe.name: recipe
    for recipe in (
        _variant(f"{_S7}/frames-4", "frames-1", {"num_frames": 1}),
        _variant(f"{_S7}/frames-4", "frames-32", {"num_frames": 32}),
        _variant(f"{_S7}/enhanced-tit", "shuffled-windows", sequence_length=None),
        _variant(
            f"{_S7}/enhanced-tit",
            "tiles-of-28-pixels",
            {"frame": Inner(patch_size=28, patch_weights="own")},
            wrappers=("minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=28)", *VIEW[1:]),
        ),
        _variant(
            f"{_S7}/enhanced-tit",
            "own-limit-seven-actions",
            env_settings=("agent_view_size=3",),
            wrappers=VIEW[:-1],
        ),
        _variant(f"{_T_MAZE}/lstm", "gru", {"history": GRU(hidden_dim=64)}),
        _variant(f"{_T_MAZE}/gtrxl", "vanilla-tit", {"history": Outer(**_ROTARY)}),
        _variant(f"{_T_MAZE}/enhanced-tit", "chained-tit", {"history": ChainedOuter(**_ROTARY)}),
        _variant(f"{_T_MAZE}/enhanced-tit", "no-positions", {"history": PairedOuter()}),
        _variant(
            f"{_T_MAZE}/enhanced-tit",
            "learned-positions",
            {"history": PairedOuter(temporal_positions="learned")},
        ),
        _variant(
            f"{_T_MAZE}/enhanced-tit",
            "relative-positions",
            {"history": PairedOuter(temporal_positions="relative")},
        ),
        _variant(f"{_T_MAZE}/enhanced-tit", "last-32-steps", {"num_frames": 32}),
    )
}
