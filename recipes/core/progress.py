"""What a run has measured so far, and the best weights that it had."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import msgspec
import torch
from torch import Tensor

from torchrl_tit.layers.standardize import widest_float

from .algorithm import Algorithm, Stateful, check_finite
from .evaluation import HeldOut, Outcome
from .recipe import Recipe

EPISODES = 20
"""Number of training episodes over which returns are averaged."""


class Record:
    """The measurements since the last row of metrics, and all evaluations so far.

    Args:
        recipe: the settings.
        algorithm: the algorithm.
    """

    def __init__(self, recipe: Recipe, algorithm: Algorithm[Any]) -> None:
        self.outcomes: list[Outcome] = []
        """The results of all evaluations so far."""
        self.held_out: list[HeldOut] = []
        """What was measured on held-out episodes so far."""
        self._recipe = recipe
        self._names = list(algorithm.columns)
        self._measured = list(algorithm.held_out_columns)
        self._required = [name not in algorithm.optional_columns for name in self._names]
        self._sums: Tensor | None = None
        self._count = 0
        self._returns: list[float] = []

    @property
    def columns(self) -> list[str]:
        """Names of the numbers in a row of metrics, besides step and time."""
        targets = self._recipe.target_columns.values()
        episodes = [] if self._recipe.offline else ["episodes"]
        return ["return_mean", *targets, *self._measured, *episodes, *self._names]

    def add(self, returns: Tensor | None, values: Mapping[str, Tensor | float]) -> None:
        """Adds the returns of a batch and the numbers of its update, without waiting for a GPU."""
        if returns is not None:
            self._returns += returns.flatten().tolist()
        if not values:  # nothing was learned
            return
        cpu = torch.device("cpu")
        device = next((x.device for x in values.values() if isinstance(x, Tensor)), cpu)
        wide = widest_float(device)
        terms = torch.stack(
            [torch.as_tensor(values[name], dtype=wide, device=device) for name in self._names]
        )
        self._sums = terms if self._sums is None else self._sums.to(terms) + terms
        self._count += 1

    def check(self) -> None:
        """Raises NotFiniteError if a sum is not finite."""
        if self._sums is not None:
            required = torch.tensor(self._required, device=self._sums.device)
            names = [n for n, needed in zip(self._names, self._required, strict=True) if needed]
            check_finite(names, self._sums[required])

    def take_row(self, step: int, *, means: bool = True) -> dict[str, float]:
        """Returns a row of metrics: the step's evaluation, and means since the last row of means.

        Args:
            step: number of steps so far.
            means: if off, the row has the evaluation only, and the means await a later row: they
                must not depend on when the run is evaluated.
        """
        row = dict.fromkeys(self.columns, math.nan)
        now = [outcome for outcome in self.outcomes if outcome.step == step]
        for target, column in self._recipe.target_columns.items():
            row[column] = next((o.mean for o in now if o.target_return == target), math.nan)
        if self._recipe.offline:
            row["return_mean"] = max((outcome.mean for outcome in now), default=math.nan)
        if self.held_out and self.held_out[-1].step == step:
            row |= {f"held_out_{name}": x for name, x in self.held_out[-1].values.items()}
        if not means:
            return row
        if self._sums is not None:
            row |= dict(zip(self._names, (self._sums / self._count).tolist(), strict=True))
        if not self._recipe.offline:
            episodes = len(self._returns)
            row["episodes"] = episodes
            row["return_mean"] = sum(self._returns) / episodes if episodes else math.nan
        self._sums, self._count, self._returns = None, 0, []
        return row

    def state_dict(self) -> dict[str, Any]:
        """Returns the state that the next row and the next evaluation need."""
        return {
            "outcomes": [asdict(outcome) for outcome in self.outcomes],
            "held_out": [asdict(held_out) for held_out in self.held_out],
            "evaluation_seed": self._recipe.evaluation_seed,
            "num_frames": self._recipe.backbone.num_frames,
            "sums": [] if self._sums is None else self._sums.tolist(),
            "count": self._count,
            "returns": self._returns,
        }

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        state = read_state(state_dict, self._recipe)
        if len(state.sums) != (len(self._names) if state.count else 0):
            raise ValueError(f"the record has {len(state.sums)} sums of {state.count} updates")
        self.outcomes, self.held_out = state.outcomes, state.held_out
        self._sums = torch.tensor(state.sums, dtype=torch.float64) if state.sums else None
        self._count = state.count
        self._returns = state.returns


@dataclass(frozen=True)
class RecordState:
    """The state of a :class:`Record` in a checkpoint."""

    outcomes: list[Outcome]
    evaluation_seed: int
    sums: list[float]
    count: Annotated[int, msgspec.Meta(ge=0)]
    returns: list[float]
    num_frames: int | None = None  # which the weights do not always determine
    held_out: list[HeldOut] = field(default_factory=list)


def read_state(state: Mapping[str, Any], recipe: Recipe) -> RecordState:
    """Reads the state of a record.

    Raises:
        ValueError: if it is not one, or the recipe's network now reads another number of frames.
    """
    record, num_frames = msgspec.convert(state, RecordState), recipe.backbone.num_frames
    if record.num_frames not in (None, num_frames):
        raise ValueError(f"num_frames is {num_frames}, but it was trained with {record.num_frames}")
    return record


class Best:
    """Keeps a copy of the weights with the highest return so far.

    That is the mean return of an evaluation during training. Where there is none, it is that of the
    last 20 training episodes, without those that ended while actions were uniformly random, and the
    weights are those that collected the last of them. Of runs
    without an environment, it is minus the error on held-out episodes. If returns are equal, the
    later weights are kept. The copy is part of each checkpoint.

    The maximum of many noisy means is biased upwards: only new episodes say what the weights reach.

    Args:
        networks: the networks that are trained.
    """

    def __init__(self, networks: Stateful) -> None:
        self.step: int | None = None
        """Number of steps that the kept weights were trained for; None if there are none yet."""
        self.return_mean = float("-inf")
        """The return that they reached in training."""
        self._networks = networks
        self._weights: dict[str, Any] = {}
        self._returns: deque[float] = deque(maxlen=EPISODES)

    def add_episodes(self, step: int, returns: Sequence[float]) -> None:
        """Adds the returns of training episodes.

        Args:
            step: number of steps that the weights which collected them were trained for.
            returns: returns of the episodes that ended in a batch.
        """
        self._returns += returns
        if returns and len(self._returns) == EPISODES:
            self.offer(step, sum(self._returns) / EPISODES)

    def forget(self) -> None:
        """Drops the weights, before they are compared by another kind of return."""
        self.step, self.return_mean, self._weights = None, float("-inf"), {}

    def offer(self, step: int, return_mean: float) -> None:
        """Keeps the current weights if no earlier ones had a higher return."""
        if return_mean >= self.return_mean:
            self.step, self.return_mean = step, return_mean
            self._weights = copy.deepcopy(self._networks.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """Returns the weights, their return, and the returns of the last episodes."""
        return {
            "step": self.step,
            "return_mean": self.return_mean,
            "networks": self._weights,
            "returns": list(self._returns),
        }

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.step, self.return_mean = state_dict["step"], state_dict["return_mean"]
        self._weights = state_dict["networks"]
        self._returns = deque(state_dict["returns"], maxlen=EPISODES)
