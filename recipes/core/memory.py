"""What every algorithm needs to train a network that carries a state."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import Compose, EnvBase

from torchrl_tit.modules import Backbone, as_sequences

from .recipe import Recipe


def state_transforms(policy: nn.Module) -> Compose:
    """Makes the transforms that carry a policy's state through an environment, if it has one."""
    backbones = (module for module in policy.modules() if isinstance(module, Backbone))
    return next((backbone.make_transforms() for backbone in backbones), Compose())


def with_transforms(env: EnvBase, transforms: Compose) -> EnvBase:
    """Adds transforms to an environment, if there are any."""
    return env.append_transform(transforms) if len(transforms) else env


def arranging(recipe: Recipe) -> Callable[[TensorDictBase], TensorDictBase] | None:
    """Returns how a recipe arranges slices of steps for its network, if that carries a state.

    Args:
        recipe: the settings, with a ``burn_in`` if the network carries a state.
    """
    if not recipe.backbone.carries_state:
        return None
    return partial(as_sequences, burn_in=getattr(recipe, "burn_in", 0))
