"""What a run records of its updates."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from recipes.algorithm import NotFiniteError
from recipes.registry import get_recipe
from recipes.runner import Record


def make_record(*columns: str, optional: tuple[str, ...] = ()) -> Record:
    algorithm: Any = SimpleNamespace(columns=columns, optional_columns=optional)
    return Record(get_recipe("dt/hopper-medium-v2/dt"), algorithm)


def test_means_are_of_the_steps_since_the_last_row():
    record = make_record("a", "b")
    for number in range(1, 5):
        record.add(None, {"a": float(number), "b": 1e-9})
    record.check()
    row = record.take_row(4)
    assert (row["a"], row["b"]) == pytest.approx((2.5, 1e-9))
    record.check()  # there is nothing to look at
    record.add(None, {"a": 7.0, "b": 0.0})
    row = record.take_row(5)
    assert (row["a"], row["b"]) == (7, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_term_that_was_not_finite_is_found_later(bad):
    record = make_record("other", "loss", "rare", optional=("rare",))
    for term in (1.0, bad, 2.0, math.inf):
        record.add(None, {"other": 0.0, "loss": term, "rare": math.nan})
    with pytest.raises(NotFiniteError, match="loss became"):
        record.check()


def test_optional_columns_may_be_nan():
    record = make_record("loss", "rare", optional=("rare",))
    record.add(None, {"loss": 1.0, "rare": math.nan})
    record.check()
    assert math.isnan(record.take_row(1)["rare"])
