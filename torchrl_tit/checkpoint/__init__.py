"""Checkpoints that are complete or absent, run no code when loaded, and resume bit for bit.

save_checkpoint, load_checkpoint    a folder of numbered checkpoints
encode, decode                      nested state as tensors and JSON
global_rng_state, ...               the global random generators
"""

from __future__ import annotations

from torchrl_tit.checkpoint.codec import decode, encode
from torchrl_tit.checkpoint.folder import (
    CheckpointError,
    CheckpointNotFoundError,
    checkpoint_steps,
    latest_step,
    load_checkpoint,
    remove_checkpoint,
    save_checkpoint,
)
from torchrl_tit.checkpoint.rng import global_rng_state, set_global_rng_state

__all__ = [
    "CheckpointError",
    "CheckpointNotFoundError",
    "checkpoint_steps",
    "decode",
    "encode",
    "global_rng_state",
    "latest_step",
    "load_checkpoint",
    "remove_checkpoint",
    "save_checkpoint",
    "set_global_rng_state",
]
