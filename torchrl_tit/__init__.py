"""Transformer in Transformer (TIT) backbones for deep RL, as TorchRL components.

Every network here is a frame encoder followed by a history encoder; everything else is TorchRL.
"""

from torchrl_tit.modules import Backbone
from torchrl_tit.networks import EnhancedTIT, VanillaTIT
from torchrl_tit.transforms import History

__all__ = ["Backbone", "EnhancedTIT", "History", "VanillaTIT"]
