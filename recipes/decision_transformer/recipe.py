"""What the recipes of Decision Transformer and Online Decision Transformer share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_tit.networks import DecisionTransformerConfig

from ..offline.outcomes import Outcome
from ..offline.recipe import OfflineRecipe
from ..recipe import check_at_least, check_at_most
from ..run import Run
from .agent import DTAgent
from .data import check_source


@dataclass(frozen=True, kw_only=True)
class SequenceRecipe(OfflineRecipe[DTAgent]):
    """Settings of every recipe that trains a Decision Transformer on a data set."""

    backbone: DecisionTransformerConfig = field(default_factory=DecisionTransformerConfig)
    """The network and its hyperparameters."""
    target_returns: tuple[float, ...]
    """Returns that the network is asked for in evaluation."""
    return_scale: float = 1000.0
    """Returns-to-go are divided by it."""
    acting_context: int | None = None
    """Steps that the network sees when it acts; those of a training window where not given, which
    are the most."""
    batch_size: int = 64
    """Subsequences in one gradient step."""
    learning_rate: float = 1e-4
    """Learning rate after warm-up."""
    warmup_updates: int = 10_000
    """Gradient steps over which the learning rate rises linearly."""
    weight_decay: float = 1e-4
    """Weight decay, on every parameter."""
    max_grad_norm: float = 0.25
    """Gradients are scaled down to this norm."""
    evaluation_episodes: int = 100
    """Episodes for each target return, in every evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.backbone, DecisionTransformerConfig):
            raise ValueError(
                f"backbone is {type(self.backbone).__name__}, but this recipe trains a "
                "decision-transformer"
            )
        check_at_least(
            self,
            learning_rate=0,
            warmup_updates=0,
            weight_decay=0,
            max_grad_norm=0,
        )
        if self.acting_context is not None:
            check_at_least(self, acting_context=1)
            check_at_most(self, acting_context=self.backbone.context)
        if not self.return_scale > 0:
            raise ValueError(f"return_scale must be positive, not {self.return_scale}")
        if not self.target_returns or not all(map(math.isfinite, self.target_returns)):
            raise ValueError(
                f"target_returns must be at least one finite number, not {self.target_returns}"
            )
        if len(set(self.outcome_columns().values())) < len(self.target_returns):
            raise ValueError(
                f"target_returns must differ within six digits, unlike {self.target_returns}"
            )

    def learning_rate_at(self, step: int) -> float:
        """Learning rate of the gradient step after so many others."""
        return self.learning_rate * min((step + 1) / max(self.warmup_updates, 1), 1)

    def schedule(self, step: int) -> dict[str, float]:
        """What follows a schedule, at the gradient step after so many others."""
        return {"learning_rate": self.learning_rate_at(step)}

    def outcome_columns(self) -> dict[float, str]:
        """Names of the metrics that hold the mean return for each target return."""
        return {target: f"return_{target:g}" for target in self.target_returns}

    def check(self) -> None:
        """Builds the network, lets it act once, and reads the data where they are here already.

        Raises:
            ValueError: if they cannot be built as the fields say, or do not fit each other.
        """
        self.torch_device()
        agent = self.make_agent()
        env = agent.make_env(1, self.target_returns[0])
        agent.actor(env.reset())
        env.close()
        check_source(self.dataset, self.backbone, **self.reading())

    def load_player(self, run: Run, **settings: Any) -> tuple[TensorDictModuleBase, EnvBase]:
        """As :meth:`Recipe.load_player`; the first target return is asked for."""
        _, agent, _ = self.load_agent(run)
        agent.eval()
        return agent.actor, agent.make_env(1, self.target_returns[0], **settings)

    def play(self, agent: DTAgent, step: int) -> list[Outcome]:
        """Plays the evaluation's episodes for each target return."""
        return [
            Outcome(
                step,
                agent.play(target, self.evaluation_episodes, self.evaluation_seed).tolist(),
                target,
            )
            for target in self.target_returns
        ]

    def make_agent(self) -> DTAgent:
        """Builds the network, untrained, with its environment."""
        agent = DTAgent(
            self.env, self.backbone, self.acting_context or self.backbone.context, self.return_scale
        )
        return agent.to(self.torch_device())
