"""Settings of the whole suite."""

import signal

import pytest
import torch

# Small networks gain nothing from threads, and parallel test workers would fight over the cores.
torch.set_num_threads(1)


# A shell that starts the suite in the background ignores Ctrl-C, which tests of it do not expect.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """A test draws the same numbers whichever tests ran before it."""
    torch.manual_seed(0)
