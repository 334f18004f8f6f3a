"""What the recipes of Decision Transformer and Online Decision Transformer share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch

from torchrl_tit.networks import DecisionTransformerConfig

from .dt_agent import DTAgent
from .dt_data import check_source
from .dt_outcomes import Outcome, summarize
from .recipe import Recipe, check_at_least
from .run import Run


@dataclass(frozen=True, kw_only=True)
class SequenceRecipe(Recipe):
    """Settings of every recipe that trains a Decision Transformer on a data set."""

    offline: ClassVar[bool] = True

    backbone: DecisionTransformerConfig = field(default_factory=DecisionTransformerConfig)
    """The network and its hyperparameters."""
    dataset: str
    """A data set: a file in D4RL's layout, or D4RL's or Minari's name."""
    env: str
    """Name of the Gymnasium environment that the network is evaluated in."""
    target_returns: tuple[float, ...]
    """Returns that the network is asked for in evaluation."""
    return_scale: float = 1000.0
    """Returns-to-go are divided by it."""
    acting_context: int | None = None
    """Steps that the network sees when it acts; those of a training window where not given."""
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
    evaluation_seed: int = 1_000_000
    """Seed of the first evaluation episode; the others follow one by one."""
    log_interval: int = 100
    """Gradient steps to a row of metrics."""
    checkpoint_interval: int = 1000
    """Gradient steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.backbone, DecisionTransformerConfig):
            raise ValueError(
                f"backbone is {type(self.backbone).__name__}, but this recipe trains a "
                "decision-transformer"
            )
        check_at_least(
            self,
            batch_size=1,
            learning_rate=0,
            warmup_updates=0,
            weight_decay=0,
            max_grad_norm=0,
            evaluation_episodes=1,
            evaluation_seed=0,
            log_interval=1,
            checkpoint_interval=1,
        )
        if self.acting_context is not None:
            check_at_least(self, acting_context=1)
        if not self.return_scale > 0:
            raise ValueError(f"return_scale must be positive, not {self.return_scale}")
        if not self.target_returns or not all(map(math.isfinite, self.target_returns)):
            raise ValueError(
                f"target_returns must be at least one finite number, not {self.target_returns}"
            )

    def evaluation_due(self, step: int) -> bool:
        """Whether the network is evaluated after so many gradient steps."""
        raise NotImplementedError

    def learning_rate_at(self, step: int) -> float:
        """Learning rate of the gradient step after so many others."""
        return self.learning_rate * min((step + 1) / max(self.warmup_updates, 1), 1)

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
        check_source(self.dataset, self.env, self.backbone)

    def evaluate(self, run: Run) -> dict[str, Any]:
        """Evaluates a run's newest checkpoint, for each target return; see :func:`summarize`.

        Episodes that were played with these weights and seeds already are not played again.

        Args:
            run: a run folder with a checkpoint.

        Raises:
            FileNotFoundError: if there is no checkpoint.
        """
        loaded = run.load()
        if loaded is None:
            raise FileNotFoundError(f"{run.checkpoints} holds no checkpoint: train the run first")
        step, state = loaded
        torch.set_num_threads(self.threads)
        agent = self.make_agent()
        with run.restoring(step):
            agent.load_state_dict(state["agent"])
            outcomes = [Outcome(**outcome) for outcome in state["outcomes"]]
        now = [
            outcome
            for outcome in outcomes
            if outcome.step == step
            and state["evaluation_seed"] == self.evaluation_seed
            and len(outcome.returns) == self.evaluation_episodes
            and outcome.target_return in self.target_returns
        ]
        if len(now) < len(self.target_returns):
            now = self.play(agent, step)
        summary = summarize(now, outcomes, self.dataset, self.env)
        return {**summary, "seed": self.evaluation_seed}

    def play(self, agent: DTAgent, step: int) -> list[Outcome]:
        """Plays the evaluation's episodes for each target return."""
        return [
            Outcome(
                step,
                target,
                agent.play(target, self.evaluation_episodes, self.evaluation_seed).tolist(),
            )
            for target in self.target_returns
        ]

    def make_agent(self) -> DTAgent:
        """Builds the network, untrained, with its environment."""
        agent = DTAgent(
            self.env, self.backbone, self.acting_context or self.backbone.context, self.return_scale
        )
        return agent.to(self.torch_device())
