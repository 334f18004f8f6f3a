"""What a Decision Transformer run needs to go on as if it had never stopped."""

from __future__ import annotations

from dataclasses import asdict

import torch
from torch import Tensor
from torchrl.data import ReplayBuffer

from torchrl_tit.checkpoint import global_rng_state, set_global_rng_state

from .dt_agent import DTAgent
from .dt_outcomes import Outcome
from .run import Run


class TrainingState:
    """All that a run needs to go on as if it had never stopped.

    Args:
        agent: the network.
        optimizer: its optimizer.
        buffer: what batches are drawn from, with its random generator.
        evaluation_seed: seed of the first episode of the evaluations.
    """

    def __init__(
        self,
        agent: DTAgent,
        optimizer: torch.optim.Optimizer,
        buffer: ReplayBuffer,
        evaluation_seed: int,
    ) -> None:
        self.agent = agent
        self.optimizer = optimizer
        self.buffer = buffer
        self.evaluation_seed = evaluation_seed
        self.outcomes: list[Outcome] = []
        """Of all evaluations so far."""
        self.saved_step = 0
        """Step of the newest checkpoint."""
        self._sums: list[float] = []  # of the losses since the last row of metrics
        self._count = 0

    def add(self, losses: Tensor) -> None:
        """Takes in the losses of one gradient step, float [terms]."""
        values = losses.tolist()
        self._sums = [a + b for a, b in zip(self._sums or [0.0] * len(values), values, strict=True)]
        self._count += 1

    def take_means(self) -> list[float]:
        """Returns the means of the losses since it was asked last."""
        means = [total / self._count for total in self._sums]
        self._sums, self._count = [], 0
        return means

    def save(self, run: Run, step: int) -> None:
        """Saves a checkpoint."""
        run.save(
            step,
            {
                "agent": self.agent.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "buffer": self.buffer.state_dict(),
                "rng": global_rng_state(),
                "outcomes": [asdict(outcome) for outcome in self.outcomes],
                "evaluation_seed": self.evaluation_seed,
                "sums": self._sums,
                "count": self._count,
            },
        )
        self.saved_step = step

    def load(self, run: Run) -> int:
        """Loads the newest checkpoint and returns its step, 0 where there is none."""
        loaded = run.load()
        if loaded is None:
            return 0
        step, state = loaded
        # Its settings are the recipe's, also where those were changed since.
        settings = self.optimizer.state_dict()["param_groups"]
        with run.restoring(step):
            self.agent.load_state_dict(state["agent"])
            self.optimizer.load_state_dict({**state["optimizer"], "param_groups": settings})
            self.buffer.load_state_dict(state["buffer"])
            self.outcomes = [Outcome(**outcome) for outcome in state["outcomes"]]
            self._sums, self._count = state["sums"], state["count"]
        set_global_rng_state(state["rng"])
        self.saved_step = step
        return step
