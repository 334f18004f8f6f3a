"""TensorDictModules: keys in, keys out."""

from torchrl_tit.modules.backbone import Backbone
from torchrl_tit.modules.heads import make_actor, make_value

__all__ = ["Backbone", "make_actor", "make_value"]
