"""Soft actor-critic on plain networks: the agent whose data D4RL is made of."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from tqdm import tqdm

from torchrl_tit.checkpoint import (
    checkpoint_steps,
    collector_state,
    global_rng_state,
    load_checkpoint,
    reset_unsavable_env,
    save_checkpoint,
    set_collector_state,
    set_global_rng_state,
)
from torchrl_tit.evaluation import finished_returns

from ..finite import check_finite
from ..interrupt import Interrupt
from ..metrics import Metrics
from ..recipe import check_at_least, check_at_most
from ..watcher import RecallingWatcher

TERMS = ["loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy"]
_KEYS = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "truncated", "done")),
]


@dataclass(frozen=True, kw_only=True)
class SAC:
    """Soft actor-critic (arXiv 1812.05905) with two critics and a learned temperature."""

    hidden_dim: int = 256
    """Width of the two layers of actor and critics."""
    learning_rate: float = 3e-4
    """Learning rate of Adam for all of them."""
    batch_size: int = 256
    """Transitions in one gradient step."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """How far the target critics move at each gradient step."""
    random_steps: int = 1000
    """Steps at the start that are uniformly random, and that nothing is learned during."""
    steps_per_batch: int = 50
    """Environment steps between two rounds of gradient steps."""
    updates_per_step: float = 1.0
    """Gradient steps for each environment step."""

    def __post_init__(self) -> None:
        check_at_least(
            self,
            hidden_dim=1,
            learning_rate=0,
            batch_size=1,
            gamma=0,
            tau=0,
            random_steps=1,
            steps_per_batch=1,
            updates_per_step=0,
        )
        check_at_most(self, gamma=1, tau=1)
        if self.random_steps % self.steps_per_batch:
            raise ValueError(
                f"random_steps {self.random_steps} are no whole batches of steps_per_batch "
                f"{self.steps_per_batch}: make it a multiple"
            )

    def make_actor(self, env: EnvBase) -> ProbabilisticActor:
        """Builds the policy: observation in; an action within the task's bounds out.

        Args:
            env: an environment that does not clip actions, for their bounds.
        """
        observation, action = _sizes(env)
        space = env.action_spec_unbatched.space
        network = nn.Sequential(
            MLP(observation, 2 * action, **self._layers()), NormalParamExtractor()
        )
        return ProbabilisticActor(
            TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": space.low, "high": space.high},
            return_log_prob=True,
        )

    def make_loss(self, env: EnvBase, actor: ProbabilisticActor) -> SACLoss:
        """Builds TorchRL's loss on an actor, with critics of its own."""
        observation, action = _sizes(env)
        # Two of them start as they were built; a single one TorchRL copies with other weights.
        critics = [
            ValueOperator(
                MLP(observation + action, 1, **self._layers()), in_keys=["observation", "action"]
            )
            for _ in range(2)
        ]
        loss = SACLoss(actor, critics, loss_function="l2", target_entropy=-float(action))
        loss.make_value_estimator(gamma=self.gamma)
        return loss

    def _layers(self) -> dict[str, Any]:
        return {"depth": 2, "num_cells": self.hidden_dim, "activation_class": nn.ReLU}


def _sizes(env: EnvBase) -> tuple[int, int]:
    """Entries of an observation and of an action."""
    return env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]


def train(
    settings: SAC,
    make_env: Callable[[int, int], EnvBase],
    folder: Path,
    watcher: RecallingWatcher,
    *,
    total_steps: int,
    checkpoint_interval: int,
    seed: int,
) -> None:
    """Trains an agent, from the folder's newest checkpoint where there is one.

    A checkpoint holds all that the run needs to go on, but for the transitions that were seen:
    these are handed to the watcher before it, and asked back from it.

    Args:
        settings: the settings.
        make_env: makes environments from their number and the seed of the first.
        folder: for ``checkpoints/``, ``metrics.csv`` and ``tensorboard/``.
        watcher: keeps what was collected, and may stop the training.
        total_steps: environment steps of the whole training.
        checkpoint_interval: environment steps between checkpoints.
        seed: of networks, environment and what is drawn.

    Raises:
        FloatingPointError: if a loss is not finite.
    """
    torch.manual_seed(seed)
    np.random.seed(seed)
    env = make_env(1, seed)
    actor = settings.make_actor(env)
    loss = settings.make_loss(env, actor)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.learning_rate, fused=True)
    target = SoftUpdate(loss, tau=settings.tau)
    collector = Collector(
        env,
        actor,
        frames_per_batch=settings.steps_per_batch,
        total_frames=math.ceil(total_steps / settings.steps_per_batch) * settings.steps_per_batch,
        init_random_frames=settings.random_steps,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(total_steps + settings.steps_per_batch),
        batch_size=settings.batch_size,
    )
    checkpoints = folder / "checkpoints"
    step = max(checkpoint_steps(checkpoints), default=0)
    for chunk in watcher.recall(step):
        buffer.extend(chunk.reshape(-1))
    if step:
        _, state = load_checkpoint(checkpoints)
        loss.load_state_dict(state["loss"])
        optimizer.load_state_dict(state["optimizer"])
        set_collector_state(collector, state["collector"])
        reset_unsavable_env(collector, seed, step)
        set_global_rng_state(state["rng"])
    saved_step = step
    returns: list[float] = []  # since the last row of metrics
    values = torch.full((len(TERMS),), torch.nan)
    columns = ["return_mean", "episodes", *TERMS]
    progress = tqdm(total=total_steps, initial=step, unit=" steps", desc="sac", smoothing=0.05)
    with (
        Interrupt() as interrupt,
        progress,
        closing(Metrics(folder, columns, last_step=step)) as metrics,
    ):
        for batch in collector:
            step += batch.numel()
            buffer.extend(batch.select(*_KEYS).reshape(-1))
            returns += finished_returns(batch).tolist()
            if step > settings.random_steps:
                for _ in range(max(1, round(batch.numel() * settings.updates_per_step))):
                    values = _update(loss, optimizer, target, buffer.sample())
                check_finite(TERMS, values, step, saved_step)
            progress.update(batch.numel())
            enough = watcher.updated(step, actor)
            # Counted from the start, so that a run that was stopped saves at the same steps.
            due = step // checkpoint_interval > (step - batch.numel()) // checkpoint_interval
            if due or enough or interrupt.requested or step >= total_steps:
                watcher.collected(step, buffer[saved_step:step].unsqueeze(0))
                metrics.log(
                    step,
                    return_mean=float(np.mean(returns)) if returns else math.nan,
                    episodes=len(returns),
                    **dict(zip(TERMS, values.tolist(), strict=True)),
                )
                state = {
                    "loss": loss.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "collector": collector_state(collector),
                    "rng": global_rng_state(),
                }
                save_checkpoint(checkpoints, step, state)
                reset_unsavable_env(collector, seed, step)
                saved_step, returns = step, []
            if interrupt.requested:
                raise KeyboardInterrupt
            if enough:
                break
    collector.shutdown()


def _update(
    loss: SACLoss, optimizer: torch.optim.Optimizer, target: SoftUpdate, batch: TensorDictBase
) -> Tensor:
    """One gradient step; returns the TERMS, float [terms]."""
    terms = loss(batch)
    optimizer.zero_grad()
    (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
    optimizer.step()
    target.step()
    return torch.stack([terms[name].detach() for name in TERMS])
