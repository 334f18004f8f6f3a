"""TensorDictModules: keys in, keys out."""

from torchrl_tit.modules.acting import acting, while_acting
from torchrl_tit.modules.backbone import Backbone
from torchrl_tit.modules.frame_cache import FrameCache
from torchrl_tit.modules.heads import make_actor, make_value
from torchrl_tit.modules.rollout_features import add_rollout_features

__all__ = [
    "Backbone",
    "FrameCache",
    "acting",
    "add_rollout_features",
    "make_actor",
    "make_value",
    "while_acting",
]
