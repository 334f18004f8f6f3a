"""The parts of PPO's update: advantages, minibatches, the objective, and what may stop it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from ..compilation import compile_and_time
from ..finite import check_finite
from .agent import Agent

if TYPE_CHECKING:
    from .recipe import PPO

TERMS = ["loss_objective", "loss_critic", "loss_entropy", "entropy", "kl_approx", "clip_fraction"]
"""What TorchRL's loss gives, of which a row of metrics has the means."""


def make_objective(
    agent: Agent,
    loss: ClipPPOLoss,
    options: Mapping[str, Any] | None,
    *,
    contrastive_coeff: float = 0.0,
    masked_fraction: float = 0.15,
) -> Callable[[TensorDict], tuple[Tensor, Tensor]]:
    """Builds the function of a minibatch that is minimised.

    Args:
        agent: the agent whose backbone writes the features.
        loss: TorchRL's loss on the heads, which read them.
        options: of ``torch.compile``; without any it is not compiled.
        contrastive_coeff: weight of the contrastive loss of CoBERL; 0 for other networks.
        masked_fraction: share of the steps that it hides.

    Returns:
        A function of a minibatch [N]: the total, float [], and its ``TERMS``, float [terms],
        followed by the contrastive loss where there is one.
    """

    def objective(minibatch: TensorDict) -> tuple[Tensor, Tensor]:
        agent.encode(minibatch)  # once; the heads read its features
        terms = loss(minibatch)
        total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
        values = [terms[name].detach() for name in TERMS]
        if contrastive_coeff:
            contrast = agent.contrastive_loss(minibatch["history"], masked_fraction)
            total = total + contrastive_coeff * contrast
            values.append(contrast.detach())
        return total, torch.stack(values)

    return compile_and_time(objective, options, "the loss") if options else objective


def make_optimizer(agent: Agent, recipe: PPO, compiled: bool) -> torch.optim.Adam:
    """Builds Adam, for an update that is compiled or not.

    What is compiled would be compiled anew for each learning rate that is a number.
    """
    rate = recipe.learning_rate
    return torch.optim.Adam(
        agent.parameters(),
        lr=torch.tensor(rate, device=recipe.torch_device()) if compiled else rate,
        eps=recipe.adam_eps,
        fused=not compiled,
        capturable=compiled and recipe.torch_device().type == "cuda",
    )


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Sets the learning rate of an optimizer of :func:`make_optimizer`."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def make_weight_update(
    optimizer: torch.optim.Optimizer, max_grad_norm: float, options: Mapping[str, Any] | None
) -> Callable[[], Tensor]:
    """Builds what follows ``backward``: scaling the gradient down, and the optimizer's step.

    Args:
        optimizer: the optimizer.
        max_grad_norm: the norm that the gradient may have.
        options: of ``torch.compile``; without any it is not compiled.

    Returns:
        A function that returns the norm that the gradient had, float [].
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]

    def update_weights() -> Tensor:
        norm = nn.utils.clip_grad_norm_(parameters, max_grad_norm)
        optimizer.step()
        return norm

    return compile_and_time(update_weights, options, "the optimizer") if options else update_weights


def add_advantages(
    batch: TensorDictBase, agent: Agent, gae: GAE, bootstrap_time_limit: bool
) -> None:
    """Writes ``advantage`` and ``value_target`` = advantage + value into a batch.

    The value of the next state is the one that the collector computed a step later, except where
    the episode or the batch ends: there the critic is asked about the true next observation.

    Args:
        batch: [envs, time], with the values of its states.
        agent: the agent whose critic is asked.
        gae: TorchRL's estimator, which stops at terminations and goes on at time limits.
        bootstrap_time_limit: if off, a time limit counts as a termination.
    """
    value = batch["state_value"]  # [envs, time, 1]
    ends = batch["next", "done"].squeeze(-1).clone()
    ends[:, -1] = True
    next_value = value.roll(-1, dims=1)
    last = batch["next"][ends].select(*agent.backbone.in_keys)
    next_value[ends] = agent.critic(agent.backbone(last))["state_value"]
    batch["next", "state_value"] = next_value
    if not bootstrap_time_limit:
        batch["next", "terminated"] = batch["next", "done"]
    gae(batch)


def minibatches(batch: TensorDictBase, recipe: PPO) -> Iterator[TensorDict]:
    """Yields shuffled minibatches of a batch, ``recipe.epochs`` times over.

    Args:
        batch: [envs, time].
        recipe: the settings.

    Yields:
        Single steps [N]; for a recurrent network sequences of consecutive steps [N, time], each
        with the state that the network had at its start.
    """
    keys = ["history", "action", "action_log_prob", "advantage", "value_target"]
    if recipe.is_recurrent:
        length = recipe.sequence_length
        keys += ["recurrent_state_h", "recurrent_state_c", "is_init"]
        samples, size = batch.select(*keys).reshape(-1, length), recipe.minibatch_size // length
    else:
        samples, size = batch.select(*keys).reshape(-1), recipe.minibatch_size
    for _ in range(recipe.epochs):
        for index in torch.randperm(len(samples), device=samples.device).split(size):
            yield samples[index]


def check_agent(agent: Agent, minibatch: TensorDictBase, step: int, saved_step: int) -> None:
    """Stops a run whose weights, or the values they give to a minibatch, are not finite.

    A step that was too long shows in the next forward pass only, not in its own losses.

    Raises:
        FloatingPointError: as :func:`check_finite`.
    """
    with torch.no_grad():
        value = agent.critic(agent.encode(minibatch))["state_value"].mean()
        weights = nn.utils.get_total_norm(agent.parameters())
    check_finite(["weights", "value"], torch.stack([weights, value]), step, saved_step)
