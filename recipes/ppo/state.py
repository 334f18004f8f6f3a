"""What a PPO run needs to go on as if it had never stopped."""

from __future__ import annotations

import torch
from torchrl.collectors import BaseCollector, Collector

from torchrl_tit.checkpoint import (
    collector_state,
    global_rng_state,
    reset_unsavable_env,
    set_collector_state,
    set_global_rng_state,
)

from ..run import Run
from .agent import Agent


class TrainingState:
    """All that a run needs to go on as if it had never stopped.

    Args:
        agent: the networks.
        optimizer: the optimizer of the agent.
        collector: the collector, with its environment. One with processes of its own starts anew
            after a stop: what happens in those is not saved.
        seed: the recipe's seed.
    """

    def __init__(
        self, agent: Agent, optimizer: torch.optim.Optimizer, collector: BaseCollector, seed: int
    ) -> None:
        self.agent = agent
        self.optimizer = optimizer
        self.collector = collector
        self.seed = seed

    def save(self, run: Run, step: int) -> None:
        """Saves a checkpoint."""
        reset_unsavable_env(self.collector, self.seed, step)
        here = self.collector if isinstance(self.collector, Collector) else None
        run.save(
            step,
            {
                "agent": self.agent.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "collector": collector_state(here) if here else None,
                "rng": global_rng_state(),
            },
        )

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
            if isinstance(self.collector, Collector) and state["collector"] is not None:
                set_collector_state(self.collector, state["collector"])
        reset_unsavable_env(self.collector, self.seed, step)
        set_global_rng_state(state["rng"])
        return step
