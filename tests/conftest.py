"""Settings of the whole suite."""

import pytest
import torch

# Small networks gain nothing from threads, and parallel test workers would fight over the cores.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """A test draws the same numbers whichever tests ran before it."""
    torch.manual_seed(0)
