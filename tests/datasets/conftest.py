"""Data that several tests read, rolled once."""

import pytest

from tests.datasets.rollouts import Transitions, roll


@pytest.fixture(scope="session")
def rolled() -> Transitions:
    return roll()


@pytest.fixture
def arrays(rolled: Transitions) -> Transitions:
    """The rolled transitions, to be changed at will."""
    return {name: array.copy() for name, array in rolled.items()}
