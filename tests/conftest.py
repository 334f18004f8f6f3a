"""Settings of the whole suite."""

import os
import signal
from collections.abc import Iterator

import pytest
import torch

# Small networks gain nothing from threads, and parallel test workers would fight over the cores.
if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(1)


# A shell that starts the suite in the background ignores Ctrl-C, which tests of it do not expect.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """A test draws the same numbers whichever tests ran before it."""
    torch.manual_seed(0)


@pytest.fixture
def float64() -> Iterator[None]:
    """Networks and inputs are made in float64, where rounding hides no mistake."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)
