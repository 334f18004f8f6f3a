"""The named recipes of tasks that only memory solves, for four kinds of memory.

All networks have the same frame encoder and about the same number of weights, and train with the
one set of PPO settings. They differ in how they remember: the last four observations side by side,
a recurrent state, a gated transformer over the last K observations, and TIT's outer blocks.
"""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.settings import LSTM, MLP, GTrXL, Inner, Network

from ..ppo import PPO
from .ppo_settings import PPO_SETTINGS, reliable_tit

_T_MAZES = {10: 50_000, 50: 200_000}
"""The number of steps by the corridor's length. At the junction, K just reaches the cue."""


def _networks(num_frames: int) -> dict[str, Network]:
    """The four memories with K observations; 4 frames and the LSTM have none to choose."""
    tit = reliable_tit("enhanced-tit", num_frames)
    # TIT's inner transformer, of which the others read the class token of the last block alone.
    last = Inner(patch_size="auto", patch_weights="own", every_block=False)
    return {
        "frames-4": replace(tit, frame=last, history=MLP(hidden_dim=96), num_frames=4),
        "lstm": replace(tit, frame=last, history=LSTM(hidden_dim=64), num_frames=1),
        "gtrxl": replace(tit, frame=last, history=GTrXL(num_blocks=1, num_heads=1)),
        "enhanced-tit": tit,
    }


MEMORY_RECIPES: dict[str, PPO] = {
    f"ppo/tmaze-{length}/{network}": PPO(
        name=f"ppo/tmaze-{length}/{network}",
        env="TMaze-v0",
        env_settings=(f"corridor_length={length}",),
        total_steps=total_steps,
        backbone=backbone,
        **PPO_SETTINGS,
    )
    for length, total_steps in _T_MAZES.items()
    for network, backbone in _networks(num_frames=length + 1).items()
}
"""The recipes by name."""
