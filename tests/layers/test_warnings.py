"""Critics that are called as one, as by TorchRL's losses, do not make PyTorch warn."""

import multiprocessing
import sys
import warnings

import pytest
import torch
from torch import Tensor
from torch.func import functional_call, stack_module_state

from torchrl_tit.layers import SelfAttention


def call_two_as_one(dropout: float) -> None:
    layers = [SelfAttention(4, 1, dropout=dropout) for _ in range(2)]
    weights, buffers = stack_module_state(list(layers))
    x = torch.randn(3, 5, 4)

    def call(weights: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        return functional_call(layers[0], (weights, buffers), (x,))

    with warnings.catch_warnings(record=True) as seen:
        torch.vmap(call, randomness="different")(weights, buffers)
    sys.exit(len(seen))


@pytest.mark.parametrize("dropout", [0.0, 0.1])
def test_no_warning(dropout: float) -> None:
    """In a process of its own: pytest has filters of its own."""
    process = multiprocessing.Process(target=call_two_as_one, args=(dropout,))
    process.start()
    process.join()
    assert process.exitcode == 0
