import random
from collections.abc import Callable

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
    numbers = random.random(), random.gauss(0, 1), np.random.normal(), *np.random.rand(3)
    return *numbers, *torch.randn(5).tolist(), *torch.randn(17).tolist()


def seed(number: int) -> None:
    for set_seed in (random.seed, np.random.seed, torch.manual_seed):
        set_seed(number)


def draw_on_gpu() -> list[float]:
    return torch.rand(3, device="cuda").tolist()


GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("numbers", [draw, pytest.param(draw_on_gpu, marks=GPU)])
def test_generators_go_on_where_they_were(tmp_path, numbers: Callable[[], object]) -> None:
    seed(1)
    numbers()  # leaves halves of normal pairs behind
    save_checkpoint(tmp_path, 1, global_rng_state())
    expected = numbers()
    seed(2)
    set_global_rng_state(load_checkpoint(tmp_path)[1])
    assert numbers() == expected


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_state_with_gpus_is_taken_on_a_machine_without() -> None:
    state = global_rng_state()
    expected = draw()
    set_global_rng_state(state | {"cuda": [torch.zeros(16, dtype=torch.uint8)]})
    assert draw() == expected
