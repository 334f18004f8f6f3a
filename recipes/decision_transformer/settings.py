"""The settings of Decision Transformer's recipes. The algorithms are in dt.py and odt.py."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Literal

from torchrl_tit.settings import DecisionTransformer, Network
from torchrl_tit.settings.checks import check_at_most
from torchrl_tit.settings.networks import decision_transformer
from torchrl_tit.settings.numbers import (
    Batch,
    Copies,
    Episodes,
    Frames,
    Positive,
    Rate,
    Real,
    Reals,
    Steps,
    StepsOrNone,
    Weight,
)

from ..dataset_recipe import DatasetRecipe

ActionSpace = Literal["continuous", "gaussian", "discrete"]


@dataclass(frozen=True, kw_only=True)
class SequenceRecipe(DatasetRecipe):
    """Settings of every recipe that trains a Decision Transformer on a data set."""

    supplies_actions: ClassVar[bool] = True

    backbone: Network = field(default_factory=decision_transformer)
    """The network: linear frames (DT) or an inner transformer (DT_TIT), and a decision-transformer
    as the history encoder. Its number of frames is that of a training window."""
    action_space: ActionSpace = "continuous"
    """How actions are predicted: "continuous" predicts actions within -1..1 with a tanh; "gaussian"
    predicts the mean and standard deviation of a tanh-squashed Gaussian; "discrete" predicts
    logits."""
    target_returns: Reals
    """Target returns of the evaluations."""
    return_scale: Positive = 1000.0
    """Divisor of the returns-to-go."""
    acting_num_frames: Frames | None = None
    """Number of steps that the network reads when it acts; the length of a training window by
    default and at most."""
    batch_size: Batch = 64
    """Windows in one gradient step."""
    learning_rate: Rate = 1e-4
    """Learning rate after warm-up."""
    warmup_updates: StepsOrNone = 10_000
    """Gradient steps over which the learning rate rises linearly."""
    weight_decay: Weight = 1e-4
    """Weight decay, on every parameter."""
    max_grad_norm: Weight = 0.25
    """Maximum gradient norm; larger gradients are scaled down to it."""
    evaluation_episodes: Episodes = 100
    """Episodes for each target return, in every evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.backbone.history, DecisionTransformer):
            raise ValueError(
                f"backbone.history is {self.backbone.history.name}, but this recipe trains a "
                "decision-transformer: choose another frame encoder, not another history encoder"
            )
        if self.acting_num_frames is not None:
            check_at_most(self, acting_num_frames=self.backbone.num_frames)
        if len(set(self.target_columns.values())) < len(self.target_returns):
            raise ValueError(
                f"target_returns must differ within six digits, unlike {self.target_returns}"
            )

    @property
    def history(self) -> DecisionTransformer:
        """The settings of the history encoder."""
        assert isinstance(self.backbone.history, DecisionTransformer)
        return self.backbone.history

    @property
    def target_columns(self) -> dict[float | None, str]:
        """Columns of metrics that hold the mean return for each target return."""
        return {target: f"return_{target:g}" for target in self.target_returns}

    def learning_rate_at(self, step: int) -> float:
        """Returns the learning rate of the gradient step after ``step`` others."""
        return self.learning_rate * min((step + 1) / max(self.warmup_updates, 1), 1)


@dataclass(frozen=True, kw_only=True)
class DT(SequenceRecipe, algorithm="dt"):
    """Decision Transformer (arXiv 2106.01345) on a data set.

    The defaults are those of its paper's MuJoCo runs, which arXiv 2212.14538 repeats with DT_TIT.
    """

    length: ClassVar[str] = "iterations"

    iterations: Steps = 10
    """Number of iterations; each ends with an evaluation."""
    updates_per_iteration: Steps = 10_000
    """Gradient steps in an iteration."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .dt import DTAlgorithm

        return DTAlgorithm(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_space == "gaussian":
            raise ValueError(
                "action_space is 'gaussian', which this loss cannot train: use 'continuous', or an "
                "odt recipe"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.iterations * self.updates_per_iteration

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether an iteration ends at a gradient step."""
        return step % self.updates_per_iteration == 0


@dataclass(frozen=True, kw_only=True)
class ODT(SequenceRecipe, algorithm="odt"):
    """Online Decision Transformer (arXiv 2202.05607).

    The defaults are those of its authors' release.
    """

    length: ClassVar[str] = "rounds"

    backbone: Network = field(
        default_factory=partial(
            decision_transformer,
            embed_dim=512,
            num_blocks=4,
            num_heads=4,
            timestep_embedding=False,
        )
    )
    """The network; see dt recipes."""
    action_space: ActionSpace = "gaussian"
    """How actions are predicted; always "gaussian" here."""
    acting_num_frames: Frames | None = 5
    """Number of steps that the network reads when it acts, at most the length of a training window;
    null is that length."""
    batch_size: Batch = 256
    """Windows in one gradient step."""
    learning_rate: Rate = 1e-4
    """Learning rate of LAMB after warm-up."""
    weight_decay: Weight = 5e-4
    """Weight decay, on every parameter."""
    alpha_init: Positive = 0.1
    """Initial weight of the entropy (the temperature)."""
    alpha_learning_rate: Rate = 1e-4
    """Learning rate of Adam for the temperature."""
    pretraining_updates: Steps = 5000
    """Gradient steps on the data set."""
    rounds: StepsOrNone = 1500
    """Rounds after pre-training, each with new episodes and gradient steps."""
    episodes_per_round: Copies = 1
    """New episodes at the beginning of a round, played side by side."""
    updates_per_round: Steps = 300
    """Gradient steps in each round."""
    online_return: Real
    """Target return of the episodes that are played for training."""
    exploration_scale: Positive = 1.0
    """Factor on the actions' standard deviation in those episodes; use less than 1 for data of
    noisy policies, because the network learns the noise too."""
    capacity: Batch = 1000
    """Number of episodes in the replay buffer."""
    evaluation_interval: Steps = 10
    """Rounds between evaluations; there is also one before the first round and one after the
    last."""
    evaluation_episodes: Episodes = 10
    """Episodes for each target return, in every evaluation."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .odt import ODTAlgorithm

        return ODTAlgorithm(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_space != "gaussian":
            raise ValueError(
                f"action_space is {self.action_space!r}, but exploration needs a distribution of "
                "continuous actions: set it to 'gaussian'"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.pretraining_updates + self.rounds * self.updates_per_round

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether pre-training or an evaluation interval ends at a gradient step."""
        rounds, within = divmod(step - self.pretraining_updates, self.updates_per_round)
        due = rounds % self.evaluation_interval == 0 or rounds == self.rounds
        return rounds >= 0 and within == 0 and due

    def round_begins(self, step: int) -> bool:
        """Returns whether a round begins after ``step`` gradient steps."""
        online = step - self.pretraining_updates
        return online >= 0 and online % self.updates_per_round == 0
