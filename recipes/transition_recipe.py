"""The base class of recipes that draw transitions with histories from a data set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torchrl_tit.settings.numbers import Batch, Episodes, Fraction, Steps, Widths

from .dataset_recipe import DatasetRecipe
from .recipe import Padding


@dataclass(frozen=True, kw_only=True)
class TransitionRecipe(DatasetRecipe):
    """Settings of every recipe that learns from transitions of a data set."""

    length: ClassVar[str] = "total_updates"

    padding: Padding = "same"
    """What fills a history before the first observation: that observation, or zeros."""
    total_updates: Steps = 500_000
    """Gradient steps to train for."""
    batch_size: Batch = 256
    """Transitions in one gradient step, sampled with replacement."""
    slice_length: Batch = 1
    """Number of consecutive transitions that are drawn together, so that a backbone encodes their
    frames once; must divide batch_size. 1 draws transitions one by one."""
    normalize_observations: bool = False
    """Whether to normalise observations by their mean and standard deviation in the data; only for
    arrays of floats."""
    time_limits: Literal["keep", "drop"] = "drop"
    """Whether to keep the last transition of an episode that a time limit truncated. D4RL's own
    function and d3rlpy 1.1.1, which the paper used, drop it."""
    unfinished: Literal["keep", "drop"] = "drop"
    """Whether to keep the last episode if the data stop before it ends."""
    evaluation_interval: Steps = 1000
    """Gradient steps between evaluations."""
    evaluation_episodes: Episodes = 10
    """Number of episodes in an evaluation, played side by side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size % self.slice_length:
            raise ValueError(
                f"slice_length {self.slice_length} does not divide batch_size {self.batch_size}: "
                "change one of them"
            )
        if self.backbone.carries_state:
            raise ValueError(
                f"{self.algorithm} draws single transitions, so its network cannot carry a state: "
                "set backbone.num_frames to 2 or more, or use a ppo recipe"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.total_updates

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether to evaluate after a number of gradient steps."""
        return step % self.evaluation_interval == 0 or step == self.total_updates

    def drawing(self) -> dict[str, Any]:
        """How transitions are drawn: arguments of :class:`~torchrl_tit.datasets.HistoryStorage`."""
        return {
            "padding": self.padding,
            "time_limits": self.time_limits,
            "unfinished": self.unfinished,
            "is_init": self.slice_length > 1,
        }


@dataclass(frozen=True, kw_only=True)
class ActorCriticRecipe(TransitionRecipe):
    """Settings of algorithms with an actor and two critics, IQL and TD3+BC."""

    total_updates: Steps = 1_000_000
    """Gradient steps to train for."""
    gamma: Fraction = 0.99
    """Discount factor."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target networks, from 0 to 1."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether value networks read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: Widths = (256, 256)
    """Widths of the hidden layers of value networks."""
    evaluation_interval: Steps = 5000
    """Gradient steps between evaluations."""
