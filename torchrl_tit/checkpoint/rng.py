"""The global random generators."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch


def global_rng_state() -> dict[str, Any]:
    """Returns the states of the global random generators of Python, NumPy and PyTorch (CPU, GPUs).

    Returns:
        A state that a checkpoint can hold. `"cuda"` is empty if this process has not used CUDA.

    Example:
        >>> import random
        >>> state = global_rng_state()
        >>> first = random.random()
        >>> set_global_rng_state(state)
        >>> random.random() == first
        True
    """
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),
        "torch": torch.get_rng_state(),
        # Reading the state would initialize CUDA on every GPU, and unused generators have none.
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
    }


def set_global_rng_state(state: dict[str, Any]) -> None:
    """Restores the states of the global random generators, see :func:`global_rng_state`.

    Args:
        state: what :func:`global_rng_state` returned. States of GPUs that this machine lacks are
            ignored; GPUs that the state lacks keep theirs.

    Example:
        >>> import torch
        >>> state = global_rng_state()
        >>> first = torch.rand(3)
        >>> set_global_rng_state(state)
        >>> torch.equal(torch.rand(3), first)
        True
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    torch.set_rng_state(state["torch"])
    for device, generator in enumerate(state["cuda"][: torch.cuda.device_count()]):
        torch.cuda.set_rng_state(generator, device)
