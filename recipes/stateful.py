"""Stateful objects of a run besides networks and optimizers."""

from __future__ import annotations

from typing import Any

from torchrl.collectors import BaseCollector, Collector

from torchrl_tit.checkpoint import collector_state, reset_unsavable_env, set_collector_state


class CollectorState:
    """The state of a run's collector and of its environment.

    A collector with its own processes starts anew when resumed, because their state is not saved.
    Environments that cannot be saved begin new episodes at each checkpoint.

    Args:
        collector: the collector.
        seed: the run's seed.
        step: environment steps so far; the caller keeps it up to date.
    """

    def __init__(self, collector: BaseCollector, seed: int, step: int) -> None:
        self.collector = collector
        self.seed = seed
        self.step = step

    def state_dict(self) -> dict[str, Any]:
        """Returns the state."""
        reset_unsavable_env(self.collector, self.seed, self.step)
        here = isinstance(self.collector, Collector)
        return {"collector": collector_state(self.collector) if here else None}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        state = state_dict["collector"]
        if isinstance(self.collector, Collector) and state is not None:
            set_collector_state(self.collector, state)
        reset_unsavable_env(self.collector, self.seed, self.step)
