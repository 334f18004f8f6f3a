"""The random generators that a whole process shares."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch


def global_rng_state() -> dict[str, Any]:
    """Take down every global random generator: Python's, numpy's, PyTorch's on the CPU and GPUs.

    Returns:
        A state that a checkpoint can hold. `"cuda"` is empty where this process has not used CUDA.

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
        # Asking for it would start CUDA on every GPU, and unused generators have nothing to tell.
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
    }


def set_global_rng_state(state: dict[str, Any]) -> None:
    """Set every global random generator, see :func:`global_rng_state`.

    Args:
        state: What :func:`global_rng_state` returned. Where it was taken with more GPUs than this
            machine has, those are left out; GPUs beyond the ones in it keep their state.

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
