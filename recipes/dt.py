"""Decision Transformer, offline: the settings, and the loop that they drive."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import nn
from tqdm import tqdm

from torchrl_tit.datasets import SequenceStorage, make_replay_buffer
from torchrl_tit.modules import make_dt_predictor
from torchrl_tit.networks import DecisionTransformerConfig
from torchrl_tit.objectives import MaskedDTLoss

from .dt_agent import DTAgent
from .dt_data import check_source, load_data, warn_of_targets
from .dt_outcomes import Outcome, summarize
from .dt_state import TrainingState
from .interrupt import Interrupt
from .ppo_update import check_finite
from .recipe import Recipe, check_at_least
from .run import Run

LOSSES = ["loss", "gradient_norm"]


@dataclass(frozen=True, kw_only=True)
class DT(Recipe):
    """Decision Transformer (arXiv 2106.01345) on a data set.

    The defaults are those of its paper's MuJoCo runs, which arXiv 2212.14538 repeats with DT_TIT.
    """

    algorithm: ClassVar[str] = "dt"

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
    iterations: int = 10
    """Evaluations of the network, one after each share of the updates."""
    updates_per_iteration: int = 10_000
    """Gradient steps before each evaluation."""
    batch_size: int = 64
    """Subsequences in one gradient step."""
    learning_rate: float = 1e-4
    """Learning rate of AdamW after warm-up."""
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
            iterations=1,
            updates_per_iteration=1,
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
        if not self.return_scale > 0:
            raise ValueError(f"return_scale must be positive, not {self.return_scale}")
        if not self.target_returns or not all(map(math.isfinite, self.target_returns)):
            raise ValueError(
                f"target_returns must be at least one finite number, not {self.target_returns}"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.iterations * self.updates_per_iteration

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

    def train(self, run: Run) -> None:
        """Trains in a run folder; see :func:`train`."""
        train(self, run)

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
        agent = DTAgent(self.env, self.backbone, self.return_scale)
        return agent.to(self.torch_device())


def train(recipe: DT, run: Run) -> None:
    """Trains a network, from the newest checkpoint of the run where there is one.

    Args:
        recipe: the settings.
        run: an open run folder.

    Raises:
        FloatingPointError: if the loss or the gradient is not finite.
    """
    torch.set_num_threads(recipe.threads)
    torch.manual_seed(recipe.seed)
    device = recipe.torch_device()

    episodes = load_data(recipe.dataset, recipe.env, recipe.backbone)
    warn_of_targets(recipe.target_returns, episodes)
    agent = recipe.make_agent()
    agent.fit_statistics(episodes)
    storage = SequenceStorage(
        episodes.to(device),
        recipe.backbone.context,
        mean=agent.mean if agent.normalizes else None,
        std=agent.std if agent.normalizes else None,
        return_scale=recipe.return_scale,
    )
    buffer = make_replay_buffer(storage, recipe.batch_size, seed=recipe.seed)
    discrete = recipe.backbone.action_space == "discrete"
    loss = MaskedDTLoss(
        make_dt_predictor(agent.network), loss_function="cross_entropy" if discrete else "l2"
    )
    parameters = list(agent.parameters())
    optimizer = torch.optim.AdamW(
        parameters, lr=recipe.learning_rate, weight_decay=recipe.weight_decay, fused=True
    )
    state = TrainingState(agent, optimizer, buffer, recipe.evaluation_seed)
    step = state.load(run)
    targets = {target: f"return_{target:g}" for target in recipe.target_returns}
    columns = ["return_mean", *targets.values(), *LOSSES, "learning_rate"]
    metrics = run.metrics(columns, last_step=step)
    progress = tqdm(
        total=recipe.final_step, initial=step, unit=" updates", desc=recipe.name, smoothing=0.05
    )
    with Interrupt() as interrupt, progress, closing(metrics):
        while step < recipe.final_step:
            for group in optimizer.param_groups:
                group["lr"] = recipe.learning_rate_at(step)
            agent.train()
            total = loss(buffer.sample())["loss"]
            optimizer.zero_grad()
            total.backward()
            norm = nn.utils.clip_grad_norm_(parameters, recipe.max_grad_norm)
            terms = torch.stack([total.detach(), norm])
            check_finite(LOSSES, terms, step, state.saved_step)
            optimizer.step()
            agent.eval()
            step += 1
            state.add(terms)

            evaluation_due = step % recipe.updates_per_iteration == 0
            if evaluation_due or step % recipe.log_interval == 0:
                returns = dict.fromkeys(["return_mean", *targets.values()], math.nan)
                if evaluation_due:
                    outcomes = recipe.play(agent, step)
                    state.outcomes += outcomes
                    returns |= {targets[o.target_return]: o.mean for o in outcomes}
                    returns["return_mean"] = max(outcome.mean for outcome in outcomes)
                    progress.set_postfix_str(f"return {returns['return_mean']:.1f}")
                metrics.log(
                    step,
                    **returns,
                    **dict(zip(LOSSES, state.take_means(), strict=True)),
                    learning_rate=optimizer.param_groups[0]["lr"],
                )
            progress.update()
            due = evaluation_due or step % recipe.checkpoint_interval == 0
            if due or interrupt.requested:
                state.save(run, step)
            if interrupt.requested:
                raise KeyboardInterrupt
