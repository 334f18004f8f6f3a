"""Frame encoders that are chosen by the kinds of observations, where a recipe names none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl_tit.networks import HistoryNetwork, chosen_by_kind

from .algorithm import Algorithm
from .recipe import Recipe


def with_chosen_frames(recipe: Recipe, algorithm: Algorithm[Any]) -> tuple[Recipe, str]:
    """Adds to a recipe the frame encoders that were chosen by the kinds of observations.

    The run's recipe.json then records them, and a resumed run keeps them in later versions too.

    Args:
        recipe: the recipe.
        algorithm: its algorithm, with the networks.

    Returns:
        The recipe for the run, and a description of what was chosen, which is empty if nothing was.
    """
    modules = algorithm.policy.modules()
    network = next((module for module in modules if isinstance(module, HistoryNetwork)), None)
    chosen = {} if network is None else network.frame_settings
    if not (described := chosen_by_kind(recipe.backbone, chosen)):
        return recipe, ""
    return replace(recipe, backbone=replace(recipe.backbone, frames=chosen)), described
