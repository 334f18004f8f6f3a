"""TensorDictModules: backbones around networks, and heads on their features."""

from __future__ import annotations

from torchrl_tit.modules.acting import ActingCollector, acting
from torchrl_tit.modules.backbone import Backbone, history_keys
from torchrl_tit.modules.decision_transformer import (
    DTHead,
    make_dt_actor,
    make_dt_backbone,
    make_dt_predictor,
)
from torchrl_tit.modules.frame_cache import FrameCache
from torchrl_tit.modules.heads import make_actor, make_squashed_actor, make_value
from torchrl_tit.modules.many_actions import ManyActions
from torchrl_tit.modules.sequences import as_sequences

__all__ = [
    "ActingCollector",
    "Backbone",
    "DTHead",
    "FrameCache",
    "ManyActions",
    "acting",
    "as_sequences",
    "history_keys",
    "make_actor",
    "make_dt_actor",
    "make_dt_backbone",
    "make_dt_predictor",
    "make_squashed_actor",
    "make_value",
]
