"""What a run takes in of its gradient steps."""

import math

import pytest
import torch

from recipes.offline.state import TrainingState


def test_means_are_of_the_steps_since_the_last():
    state = TrainingState({}, evaluation_seed=0)
    for number in range(1, 5):
        state.add(torch.tensor([number, 1e-9]))
    state.check(["a", "b"], 4)
    assert state.take_means() == pytest.approx([2.5, 1e-9])
    state.check(["a", "b"], 4)  # nothing to look at
    state.add(torch.tensor([7.0, 0.0]))
    assert state.take_means() == [7, 0]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_term_that_was_not_finite_is_found_later(bad):
    state = TrainingState({}, evaluation_seed=0)
    for term in (1.0, bad, 2.0, math.inf):
        state.add(torch.tensor([0.0, term]))
    message = r"loss became .* in the update at step 4; none was saved"
    with pytest.raises(FloatingPointError, match=message):
        state.check(["other", "loss"], 4)
