"""Checkpoints that are complete or absent, run no code when loaded, and resume bit for bit.

save_checkpoint, load_checkpoint    a folder of numbered checkpoints
encode, decode                      nested state as tensors and JSON
env_state, collector_state, ...     state that TorchRL cannot save
"""

from torchrl_tit.checkpoint.codec import decode, encode
from torchrl_tit.checkpoint.collector import (
    collector_state,
    reset_unsavable_env,
    set_collector_state,
)
from torchrl_tit.checkpoint.environment import can_save_env, env_state, set_env_state
from torchrl_tit.checkpoint.errors import CheckpointError, CheckpointNotFoundError
from torchrl_tit.checkpoint.folder import (
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
    "can_save_env",
    "checkpoint_steps",
    "collector_state",
    "decode",
    "encode",
    "env_state",
    "global_rng_state",
    "latest_step",
    "load_checkpoint",
    "remove_checkpoint",
    "reset_unsavable_env",
    "save_checkpoint",
    "set_collector_state",
    "set_env_state",
    "set_global_rng_state",
]
