"""The data of Decision Transformer's recipes, and whether they fit them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

from torchrl_tit.datasets import Episodes, load_episodes
from torchrl_tit.networks import DecisionTransformerConfig

from ..offline.recipe import is_remote


def load_data(dataset: str, config: DecisionTransformerConfig, **reading: Any) -> Episodes:
    """Loads episodes and checks that a network can be trained on them.

    Args:
        dataset: a name or a path.
        config: the network's settings.
        **reading: as for :func:`~torchrl_tit.datasets.load_episodes`.

    Raises:
        ValueError: if its actions are of the other kind, no episode is finished, or one is longer
            than the network allows.
        FileNotFoundError: if there are no such data.
    """
    episodes = load_episodes(dataset, **reading)
    continuous = episodes.rows["action"].is_floating_point()
    if continuous == (config.action_space == "discrete"):
        kind = "continuous" if continuous else "discrete"
        raise ValueError(
            f"the actions in {dataset} are {kind} ({episodes.rows['action'].dtype}), but the "
            f"head's are {config.action_space}: set backbone.action_space to {kind!r}, or take "
            "other data (discrete actions are integers)"
        )
    if not episodes.finished.any():
        raise ValueError(f"no episode in {dataset} is finished, so what it returns is not known")
    longest = int(episodes.lengths[episodes.finished].max())  # the others are not trained on
    if config.timestep_embedding and longest > config.max_ep_len:
        raise ValueError(
            f"episodes in {dataset} have up to {longest} steps, but max_ep_len is "
            f"{config.max_ep_len}: raise backbone.max_ep_len to {longest} or more"
        )
    return episodes


def check_source(dataset: str, config: DecisionTransformerConfig, **reading: Any) -> None:
    """Checks what can be checked without a download: local data wholly, else the name alone."""
    if not is_remote(dataset):
        load_data(dataset, config, **reading)


def warn_of_targets(target_returns: Sequence[float], episodes: Episodes) -> None:
    """Warns of returns that are asked for, but lie outside those of the data's episodes."""
    returns = episodes.returns[episodes.finished.cpu()]
    low, high = returns.min().item(), returns.max().item()
    outside = [target for target in target_returns if not low <= target <= high]
    if outside:
        warnings.warn(
            f"target_returns {', '.join(f'{target:g}' for target in outside)}: no episode in "
            f"{episodes.source} has such a return; they reach from {low:.1f} to {high:.1f}, with a "
            f"mean of {returns.mean().item():.1f}",
            stacklevel=3,
        )
