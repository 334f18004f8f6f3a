"""The kinds of numbers in settings, each with the bounds of sensible values.

:func:`~torchrl_tit.settings.checks.check_fields` enforces the bounds, and rejects numbers that are
not finite in any field.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

MAX_SEED = 2**31
"""NumPy takes 32 bits, and environments are seeded with a run's seed and the numbers after it."""

Width = Annotated[int, Meta(ge=1, le=65_536)]
"""Entries of a token, a layer or a state."""
Size = Annotated[int, Meta(ge=1, le=10**9)]
"""Sizes that depend on a task: of features, observations, actions."""
Widths = Annotated[
    tuple[Width, ...],
    Meta(min_length=1, description="at least one width of at least 1 and at most 65536"),
]
"""Widths of the layers of a network."""
Count = Annotated[int, Meta(ge=1, le=1000)]
"""Blocks, layers, heads or multiples of a width."""
CountOrNone = Annotated[int, Meta(ge=0, le=1000)]
"""Multiples of a width, where 0 leaves a part out."""
Frames = Annotated[int, Meta(ge=1, le=10_000)]
"""Observations of a history."""
Steps = Annotated[int, Meta(ge=1, le=10**12)]
"""Steps or updates of a run, and intervals of them."""
StepsOrNone = Annotated[int, Meta(ge=0, le=10**12)]
"""Steps or updates, possibly none."""
Batch = Annotated[int, Meta(ge=1, le=10**9)]
"""Steps, transitions or windows that are held at once."""
Copies = Annotated[int, Meta(ge=1, le=10_000)]
"""Environments, processes or episodes in parallel."""
Episodes = Annotated[int, Meta(ge=1, le=100_000)]
"""Episodes of an evaluation."""
Threads = Annotated[int, Meta(ge=1, le=1024)]
"""Threads of a processor."""
Seed = Annotated[int, Meta(ge=0, le=MAX_SEED)]
"""Seeds of random number generators."""

Rate = Annotated[float, Meta(ge=0, le=10)]
"""Learning rates."""
Weight = Annotated[float, Meta(ge=0, le=1e9)]
"""Weights of loss terms, and other factors that may be 0."""
Positive = Annotated[float, Meta(gt=0, le=1e9)]
"""Factors that cannot be 0."""
Real = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""Returns and other numbers of any sign."""
Fraction = Annotated[float, Meta(ge=0, le=1)]
"""Fractions, discounts, and update rates of target networks."""
Share = Annotated[float, Meta(gt=0, le=1)]
"""Shares of something that cannot be empty."""
Probability = Annotated[float, Meta(ge=0, lt=1, description="a probability in [0, 1)")]
"""Probabilities below 1, such as dropout."""
Inside = Annotated[float, Meta(gt=0, lt=1, description="a probability in (0, 1)")]
"""Probabilities above 0 and below 1."""
