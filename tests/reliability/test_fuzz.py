"""A slice of `make fuzz`: nonsense is refused in one line, or is no nonsense."""

import pytest

from tests.reliability.fuzz import KINDS, fuzz


@pytest.mark.parametrize("kind", KINDS)
def test_nonsense_is_refused_in_one_line(kind: str) -> None:
    outcome = fuzz(kind, inputs=25)
    assert not outcome.faults, outcome.faults[0]
    assert outcome.counts["refused"] > 5  # it is nonsense
