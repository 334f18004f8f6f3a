"""What a run on a data set needs to go on as if it had never stopped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Protocol

import torch
from torch import Tensor

from torchrl_tit.checkpoint import global_rng_state, load_checkpoint, set_global_rng_state

from ..finite import check_finite
from ..run import Run
from .outcomes import Outcome


class Stateful(Protocol):
    """What has a state that can be saved: modules, optimizers, replay buffers."""

    def state_dict(self) -> dict[str, Any]:
        """Returns the state."""

    def load_state_dict(self, state_dict: dict[str, Any], /) -> Any:
        """Takes a state over."""


class TrainingState:
    """All that a run needs to go on as if it had never stopped.

    Args:
        parts: the network ("agent"), optimizers, and what batches are drawn from.
        evaluation_seed: seed of the first episode of the evaluations.
    """

    def __init__(self, parts: Mapping[str, Stateful], evaluation_seed: int) -> None:
        self.outcomes: list[Outcome] = []
        """Of all evaluations so far."""
        self.saved_step = 0
        """Step of the newest checkpoint."""
        self._parts = parts
        self._evaluation_seed = evaluation_seed
        self._sums: Tensor | None = None  # of the terms since the last row of metrics
        self._count = 0

    def add(self, terms: Tensor) -> None:
        """Takes in what one gradient step gave, float [terms], without waiting for a GPU."""
        terms = terms.double()
        self._sums = terms if self._sums is None else self._sums.to(terms.device) + terms
        self._count += 1

    def check(self, names: Sequence[str], step: int) -> None:
        """Stops a run where what it took in is not finite.

        Args:
            names: of the terms, or of the first ones if only these are looked at.
            step: gradient steps so far, for messages.

        Raises:
            FloatingPointError: naming the term and the newest checkpoint.
        """
        if self._sums is not None:
            check_finite(names, self._sums[: len(names)], step, self.saved_step)

    def take_means(self) -> list[float]:
        """Returns the means of the terms since it was asked last."""
        assert self._sums is not None
        means = [total / self._count for total in self._sums.tolist()]
        self._sums, self._count = None, 0
        return means

    def save(self, run: Run, step: int) -> None:
        """Saves a checkpoint."""
        run.save(
            step,
            {
                **{name: part.state_dict() for name, part in self._parts.items()},
                "rng": global_rng_state(),
                "outcomes": [asdict(outcome) for outcome in self.outcomes],
                "evaluation_seed": self._evaluation_seed,
                "sums": [] if self._sums is None else self._sums.tolist(),
                "count": self._count,
            },
        )
        self.saved_step = step

    def load(self, run: Run, step: int) -> None:
        """Loads the checkpoint of a step; where that is 0, there is none."""
        if step == 0:
            return
        _, state = load_checkpoint(run.checkpoints, step)
        with run.restoring(step):
            for name, part in self._parts.items():
                _load(part, state[name])
            self.outcomes = [Outcome(**outcome) for outcome in state["outcomes"]]
            sums = state["sums"]
            self._sums = torch.tensor(sums, dtype=torch.float64) if sums else None
            self._count = state["count"]
        set_global_rng_state(state["rng"])
        self.saved_step = step


def _load(part: Stateful, state: dict[str, Any]) -> None:
    if isinstance(part, torch.optim.Optimizer):
        # Its settings are the recipe's, also where those were changed since; not so its counters.
        groups = zip(state["param_groups"], part.state_dict()["param_groups"], strict=True)
        kept = [{**own, **{k: saved[k] for k in saved if k == "step"}} for saved, own in groups]
        state = {**state, "param_groups": kept}
    part.load_state_dict(state)
