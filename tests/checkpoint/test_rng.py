import random

import numpy as np
import pytest
import torch

from torchrl_tit.checkpoint import (
    global_rng_state,
    load_checkpoint,
    save_checkpoint,
    set_global_rng_state,
)


def draw() -> tuple[object, ...]:
    return (
        random.random(),
        random.gauss(0, 1),
        np.random.normal(),
        np.random.rand(3).tolist(),
        torch.randn(5).tolist(),
        torch.randn(17).tolist(),
    )


def test_generators_go_on_where_they_were(tmp_path) -> None:
    random.seed(1)
    np.random.seed(1)
    torch.manual_seed(1)
    draw()  # leaves halves of normal pairs behind
    save_checkpoint(tmp_path, 1, global_rng_state())
    expected = draw()
    random.seed(2)
    np.random.seed(2)
    torch.manual_seed(2)
    _, state = load_checkpoint(tmp_path)
    set_global_rng_state(state)
    assert draw() == expected


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_gpu_generators(tmp_path) -> None:
    torch.rand(3, device="cuda")
    save_checkpoint(tmp_path, 1, global_rng_state())
    expected = torch.rand(3, device="cuda")
    set_global_rng_state(load_checkpoint(tmp_path)[1])
    assert torch.rand(3, device="cuda").equal(expected)


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_state_with_gpus_is_taken_on_a_machine_without() -> None:
    state = global_rng_state()
    expected = draw()
    set_global_rng_state(state | {"cuda": [torch.zeros(16, dtype=torch.uint8)]})
    assert draw() == expected
