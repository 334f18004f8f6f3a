"""A run stops where numbers are no numbers any more."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor


def check_finite(terms: Sequence[str], values: Tensor, step: int, saved_step: int) -> None:
    """Stops a run where a loss, say, is not finite.

    Args:
        terms: names of the values.
        values: float [terms].
        step: environment steps, or gradient steps, so far.
        saved_step: step of the last checkpoint.

    Raises:
        FloatingPointError: naming the term, the step and the last good checkpoint.
    """
    finite = values.isfinite()
    if not finite.all():
        index = int(finite.logical_not().nonzero()[0])
        saved = f"the checkpoint of step {saved_step} is good" if saved_step else "none was saved"
        raise FloatingPointError(
            f"{terms[index]} became {values[index].item()} in the update at step {step}; {saved}"
        )
