"""The loop of PPO: collect a batch, estimate advantages, update on minibatches."""

from __future__ import annotations

import random
from collections.abc import Mapping
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.evaluation import finished_returns
from torchrl_tit.modules import while_acting

from ..compilation import compile_options, should_compile
from ..finite import check_finite
from ..interrupt import Interrupt
from ..run import Run
from ..watcher import Watcher
from .agent import Agent
from .collector import make_collector
from .state import TrainingState
from .update import (
    TERMS,
    add_advantages,
    check_agent,
    make_objective,
    make_optimizer,
    make_weight_update,
    minibatches,
    set_learning_rate,
)

if TYPE_CHECKING:
    from .recipe import PPO


def train(recipe: PPO, run: Run, watcher: Watcher | None = None) -> None:
    """Trains an agent, from the newest checkpoint of the run where there is one.

    Args:
        recipe: the settings.
        run: an open run folder.
        watcher: is shown every batch and every update, and may stop the run at a checkpoint.

    Raises:
        FloatingPointError: if a loss or the gradient is not finite.
    """
    torch.set_num_threads(recipe.threads)
    random.seed(recipe.seed)
    np.random.seed(recipe.seed)
    torch.manual_seed(recipe.seed)

    env = recipe.make_env(
        recipe.num_envs, recipe.seed, vectorization_mode=recipe.vectorization_mode
    )
    agent = Agent(recipe, env).eval()  # no dropout while acting
    # How long a sequence is varies with where episodes begin.
    compiled = not recipe.is_recurrent and should_compile(recipe.compile, recipe.gradient_steps)
    options = compile_options(recipe.cuda_graphs, recipe.torch_device()) if compiled else None
    if options is not None and agent.backbone.keeps_frames:
        agent.backbone.compile_parts(**options)
    update = PPOUpdate(recipe, agent, options)
    step = saved_step = max(checkpoint_steps(run.checkpoints), default=0)
    collector = make_collector(recipe, env, agent, step, options)
    state = TrainingState(agent, update.optimizer, collector, recipe.seed)
    state.load(run)
    columns = ["return_mean", "episodes", "learning_rate", "feature_spread", *update.terms]
    metrics = run.metrics(columns, last_step=step)
    progress = tqdm(
        total=recipe.final_step, initial=step, unit=" steps", desc=recipe.name, smoothing=0.05
    )
    with Interrupt() as interrupt, progress, closing(metrics):
        for batch in while_acting(agent.policy, collector):
            before, step = step, step + batch.numel()
            if watcher is not None:
                watcher.collected(step, batch)
            means = update(batch, step, saved_step)
            if recipe.collectors > 1:
                collector.update_policy_weights_()

            finished = finished_returns(batch)
            mean_return = finished.mean().item()  # NaN where no episode ended
            metrics.log(step, return_mean=mean_return, episodes=len(finished), **means)
            progress.update(batch.numel())
            if len(finished):
                progress.set_postfix_str(f"return {mean_return:.1f}")
            # Counted from the start, so that a run that was stopped saves at the same steps.
            due = step // recipe.checkpoint_interval > before // recipe.checkpoint_interval
            enough = watcher is not None and watcher.updated(step, agent.policy)
            if due or enough or interrupt.requested or step >= recipe.final_step:
                state.save(run, step)
                saved_step = step
            if interrupt.requested:
                raise KeyboardInterrupt
            if enough:
                break
    collector.shutdown()


class PPOUpdate:
    """All that is done with a batch: advantages, then passes over its minibatches.

    Args:
        recipe: the settings.
        agent: the networks, in evaluation mode; in training mode while they are updated.
        options: of ``torch.compile``; without any nothing is compiled.
    """

    def __init__(self, recipe: PPO, agent: Agent, options: Mapping[str, Any] | None) -> None:
        self.recipe = recipe
        self.agent = agent
        self.terms = [
            *TERMS,
            *(["loss_contrastive"] if recipe.contrastive_coeff else []),
            "gradient_norm",
        ]
        """What a gradient step gives."""
        self.loss = ClipPPOLoss(
            agent.actor,
            agent.critic,
            clip_epsilon=recipe.clip_epsilon,
            entropy_coeff=recipe.entropy_coeff,
            critic_coeff=recipe.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=True,
            log_explained_variance=False,
            functional=False,
        )
        self.objective = make_objective(
            agent,
            self.loss,
            options,
            contrastive_coeff=recipe.contrastive_coeff,
            masked_fraction=recipe.masked_fraction,
        )
        self.gae = GAE(gamma=recipe.gamma, lmbda=recipe.gae_lambda, value_network=None)
        # On a processor Adam's own fused kernel is faster than what is compiled.
        on_gpu = options is not None and recipe.torch_device().type == "cuda"
        compiled = recipe.compile_optimizer == "on" or (
            recipe.compile_optimizer == "auto" and on_gpu
        )
        self.optimizer = make_optimizer(agent, recipe, compiled)
        if compiled and options is None:
            options = compile_options(recipe.cuda_graphs, recipe.torch_device())
        self.update_weights = make_weight_update(
            self.optimizer, recipe.max_grad_norm, options if compiled else None
        )

    def __call__(self, batch: TensorDictBase, step: int, saved_step: int) -> dict[str, float]:
        """Updates the agent.

        Args:
            batch: what was collected, [envs, time]; advantages are written into it.
            step: environment steps until its end.
            saved_step: step of the newest checkpoint, for messages.

        Returns:
            The means of ``terms``, "learning_rate" and "feature_spread".

        Raises:
            FloatingPointError: if a loss or the gradient is not finite.
        """
        recipe, agent = self.recipe, self.agent
        set_learning_rate(self.optimizer, recipe.learning_rate_at(step))
        if recipe.decay_clip_epsilon:
            remaining = 1 - (step - batch.numel()) / recipe.final_step
            self.loss.clip_epsilon.fill_(recipe.clip_epsilon * remaining)
        reward = batch["next", "reward"]
        reward = reward.sign() if recipe.clip_rewards else reward
        batch["next", "reward"] = reward * recipe.reward_scale
        with torch.no_grad():
            add_advantages(batch, agent, self.gae, recipe.bootstrap_time_limit)
        agent.train()
        losses = []
        for minibatch in minibatches(batch, recipe):
            try:
                total, values = self.objective(minibatch)
            except RuntimeError:  # TorchRL draws samples where an entropy is not finite
                check_agent(agent, minibatch, step, saved_step)
                raise
            self.optimizer.zero_grad()
            total.backward()
            norm = self.update_weights()
            losses.append(torch.cat([values, norm.unsqueeze(0)]))
            check_finite(self.terms, losses[-1], step, saved_step)
        agent.eval()
        check_agent(agent, minibatch, step, saved_step)  # before it is saved
        # Where this goes to 0, the features are the same in all states, and so is the policy.
        features = batch[agent.backbone.out_keys[0]].flatten(0, -2)  # [steps, features]
        return {
            "learning_rate": float(self.optimizer.param_groups[0]["lr"]),
            "feature_spread": features.std(0).mean().item(),
            **dict(zip(self.terms, torch.stack(losses).mean(0).tolist(), strict=True)),
        }
