"""Settings of conservative Q-learning; the algorithms are in algorithm.py and discrete.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchrl_tit.settings.numbers import Count, Fraction, Positive, Rate, Weight, Widths

from ..recipe import Compile
from ..transition_recipe import TransitionRecipe


@dataclass(frozen=True, kw_only=True)
class QRecipe(TransitionRecipe):
    """Settings of both recipes of conservative Q-learning."""

    gamma: Fraction = 0.99
    """Discount factor."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target networks at each gradient step, from 0 to 1."""
    conservative_weight: Weight = 5.0
    """Weight of the conservative term."""
    adam_eps: Weight = 1e-8
    """Epsilon of Adam."""
    terminal_observations: Literal["keep", "zero"] = "zero"
    """Whether to keep terminal observations, or zero them as d3rlpy 1.1.1 did. No loss reads
    them."""
    compile: Compile = "auto"
    """Whether the losses run through torch.compile, which needs a C++ compiler and about a minute
    at the start. "auto" compiles if the run is long enough to be worth it. On a CPU, continuous CQL
    compiles only the policy, because compiling does not speed up the critics' matrix products.
    Discrete CQL is compiled only on a GPU, and slices of several transitions are never compiled."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.compile == "on" and self.slice_length > 1:
            raise ValueError(
                f"compile is on, but slices of {self.slice_length} are not compiled, because their "
                "number of frames varies: set compile to off, or slice_length to 1"
            )

    def drawing(self) -> dict[str, Any]:
        """As :meth:`TransitionRecipe.drawing`."""
        return {**super().drawing(), "terminal_observations": self.terminal_observations}


@dataclass(frozen=True, kw_only=True)
class CQL(QRecipe, algorithm="cql"):
    """Conservative Q-learning (arXiv 2006.04779) on a data set with continuous actions.

    The defaults are those of d3rlpy 1.1.1, with which arXiv 2212.14538 trained CQL_TIT.
    """

    actor_learning_rate: Rate = 1e-4
    """Learning rate of Adam for the actor."""
    critic_learning_rate: Rate = 3e-4
    """Learning rate of Adam for the critics."""
    temperature_learning_rate: Rate = 1e-4
    """Learning rate of Adam for the temperature."""
    temperature_init: Positive = 1.0
    """Initial weight of the entropy."""
    action_samples: Count = 10
    """Actions sampled in each state from each of: uniform, the policy at s, the policy at s'."""
    over_critics: Literal["mean", "sum"] = "mean"
    """Whether the conservative term is the mean over the two critics, as in d3rlpy 1.1.1, or their
    sum, as in d3rlpy since 2.5."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: Widths = (256, 256, 256)
    """Widths of the critics' hidden layers."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import CQLAlgorithm

        return CQLAlgorithm(self)


@dataclass(frozen=True, kw_only=True)
class DiscreteCQL(QRecipe, algorithm="discrete-cql"):
    """Conservative Q-learning (arXiv 2006.04779) with a value for each action, and TorchRL's loss.

    The squared error is halved, as in TorchRL. The paper ran no discrete task offline.
    """

    conservative_weight: Weight = 1.0
    """Weight of the conservative term."""
    learning_rate: Rate = 3e-4
    """Learning rate of Adam."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .discrete import DiscreteCQLAlgorithm

        return DiscreteCQLAlgorithm(self)
