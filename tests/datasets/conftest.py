"""Data that several tests share."""

import pytest

from tests.datasets.rollouts import Transitions, roll


@pytest.fixture(scope="session")
def rolled() -> Transitions:
    return roll()


@pytest.fixture
def arrays(rolled: Transitions) -> Transitions:
    """A copy of the transitions, which a test may change."""
    return {name: array.copy() for name, array in rolled.items()}
