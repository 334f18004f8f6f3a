"""Other networks for the memory tasks: ``benchmarks/memory_variants.py:ppo/tmaze-50/gru``.

Each differs from a named recipe in one thing, and is a recipe for every command that takes one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from recipes.ppo import PPO
from recipes.registry import get_recipe
from torchrl_tit.settings import GRU, Network, Outer
from torchrl_tit.settings.histories import ChainedOuter


def _variant(recipe: str, name: str, **changes: Any) -> PPO:
    """Returns a recipe with another network; a history encoder keeps its positions."""
    named = get_recipe(recipe)
    assert isinstance(named, PPO)
    assert isinstance(named.backbone, Network)
    backbone = replace(named.backbone, **changes)
    return replace(named, name=f"{recipe.rpartition('/')[0]}/{name}", backbone=backbone)


def _positions(kind: str) -> Any:
    backbone: Any = get_recipe("ppo/tmaze-50/enhanced-tit").backbone
    return replace(backbone.history, temporal_positions=kind)


RECIPES: dict[str, PPO] = {
    recipe.name: recipe
    for recipe in (
        _variant("ppo/memory-s7/frames-4", "frames-1", num_frames=1),
        _variant("ppo/memory-s7/frames-4", "frames-32", num_frames=32),
        _variant("ppo/tmaze-50/lstm", "gru", history=GRU(hidden_dim=64)),
        _variant("ppo/tmaze-50/gtrxl", "vanilla-tit", history=Outer(temporal_positions="rotary")),
        _variant(
            "ppo/tmaze-50/enhanced-tit",
            "chained-tit",
            history=ChainedOuter(temporal_positions="rotary"),
        ),
        *(
            _variant("ppo/tmaze-50/enhanced-tit", f"enhanced-tit-{kind}", history=_positions(kind))
            for kind in ("none", "learned", "relative")
        ),
        _variant("ppo/tmaze-50/enhanced-tit", "enhanced-tit-k32", num_frames=32),
    )
}
