"""PPO with any backbone: collect a batch, estimate advantages, update on minibatches."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_tit.envs import observation_specs
from torchrl_tit.envs.action_masks import MASK
from torchrl_tit.evaluation import evaluate, finished_returns
from torchrl_tit.frames.normalized import NormalizedFrames
from torchrl_tit.layers import init_orthogonal_, standardize
from torchrl_tit.modules import Backbone, history_keys, make_actor, make_value
from torchrl_tit.modules.backbone import trunks_of
from torchrl_tit.networks import build_network, masked_predictions
from torchrl_tit.objectives import contrastive_prediction_loss

from ..algorithm import Algorithm, Stateful, check_finite
from ..compilation import (
    STATIC_SHAPES,
    autocast_type,
    check_compiler,
    compile_and_time,
    should_compile,
)
from ..outcomes import Outcome
from ..policies import normalize_frames
from ..ray_collector import check_cluster
from ..task import make_task
from .collectors import make_collector, with_state
from .flat_parameters import FlatParameters
from .learning_rate import KLAdaptiveRate
from .rollout import Rollout
from .scaling import AdvantageScale, ReturnScale, normalize_advantages
from .settings import PPO

TERMS = ["loss_objective", "loss_critic", "loss_entropy", "entropy", "kl_approx", "clip_fraction"]
"""The terms of TorchRL's loss, whose means are in each row of metrics."""


class Agent(nn.Module):
    """Backbone, actor and critic; the heads read the features that the backbone writes.

    Args:
        recipe: the settings.
        env: the task, for its shapes and its action space.
    """

    def __init__(self, recipe: PPO, env: EnvBase) -> None:
        super().__init__()
        self.recipe = recipe
        observation = observation_specs(env)
        separate = recipe.backbone.trunks == "separate"
        keys = ["policy_features", "value_features"] if separate else ["features"]
        network = build_network(recipe.backbone, observation)
        self.backbone = Backbone(
            network,
            in_keys=history_keys(observation),
            out_keys=keys,
            padding=recipe.padding,
        )
        if recipe.initialization == "orthogonal":
            init_orthogonal_(self.backbone)
        if recipe.normalize_observations:
            normalize_frames(network)
        features_dim = self.backbone.features_dim
        self.mask_key = MASK if recipe.mask_actions else None
        self.actor = make_actor(
            features_dim,
            env.action_spec_unbatched,
            in_key=keys[0],
            mask_key=self.mask_key,
            batch_dims=0,
        )
        self.critic = make_value(features_dim, in_key=keys[-1])

    def encode(self, samples: TensorDictBase) -> TensorDictBase:
        """Writes the features of single steps [N], or of sequences [N, time]."""
        with set_recurrent_mode(samples.ndim == 2):
            return self.backbone(samples)

    def rollout(self, batch: TensorDictBase) -> Rollout:
        """Arranges the frames of a collected batch for windows; see :class:`Rollout`."""
        backbone, network = self.backbone, self.recipe.backbone
        keys = backbone.sequence_keys.observations
        return Rollout(batch, network.num_frames, self.recipe.padding, keys)

    @property
    def state_keys(self) -> list[str]:
        """The keys that the network reads besides observations: its state, if it carries one."""
        states = self.backbone.state_shapes
        return [*states, "is_init"] if states else []

    @property
    def step_keys(self) -> list[str]:
        """The keys of a step that training needs besides its observation."""
        masks = [] if self.mask_key is None else [self.mask_key]
        results = ["action", "action_log_prob", "advantage", "value_target"]
        return [*self.state_keys, *masks, *results]

    def update_statistics(self, rollout: Rollout) -> None:
        """Adds the observation of each step of a batch to the statistics that normalise them.

        Neither padding nor the frames before the batch are added, nor the last observation of an
        episode, in which nobody acts. Call it between an update and the next batch: a batch is then
        collected and learned from with the same statistics.
        """
        for trunk in trunks_of(self.backbone.module).values():
            for encoder, table in zip(trunk.frames, rollout.frames, strict=True):
                if isinstance(encoder, NormalizedFrames):
                    encoder.update(table[rollout.newest])

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy: histories in; features, action, its log-probability and state value out."""
        return TensorDictSequential(self.backbone, self.actor, self.critic)


class PPOAlgorithm(Algorithm[PPO]):
    """PPO as in Stable-Baselines3, on TorchRL's loss and collectors.

    Args:
        recipe: the settings.
    """

    def __init__(self, recipe: PPO) -> None:
        super().__init__(recipe)
        task = make_task(recipe, 1)
        self.model = self.agent = Agent(recipe, task).to(self.device)
        task.close()
        self.agent.backbone.autocast = autocast_type(recipe.precision, self.device)
        contrastive = ["loss_contrastive"] if recipe.contrastive_coeff else []
        self.terms = [*TERMS, *contrastive, "gradient_norm"]
        self.columns = [
            "learning_rate",
            "feature_spread",
            "explained_variance",
            "epochs",
            *self.terms,
        ]
        self.return_scale = ReturnScale(recipe.gamma)
        self.advantage_scale = AdvantageScale()
        self.rate = KLAdaptiveRate(recipe.target_kl or math.inf)

    @property
    def policy(self) -> TensorDictModuleBase:
        """See :attr:`Agent.policy`."""
        return self.agent.policy

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories, and with the state of a recurrent network."""
        return with_state(make_task(self.recipe, num_envs, seed, **settings), self.agent.backbone)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds loss, optimizer and collector."""
        recipe, agent = self.recipe, self.agent.eval()
        self.loss = ClipPPOLoss(
            agent.actor,
            agent.critic,
            clip_epsilon=recipe.clip_epsilon,
            entropy_coeff=recipe.entropy_coeff,
            critic_coeff=recipe.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=not (recipe.advantage_floor or recipe.running_advantage_floor),
            log_explained_variance=False,
            functional=False,
        )
        self.gae = GAE(gamma=recipe.gamma, lmbda=recipe.gae_lambda, value_network=None)
        trained = [parameter for parameter in agent.parameters() if parameter.requires_grad]
        self.parameters = FlatParameters(trained).flat
        self.optimizer = torch.optim.Adam(
            [self.parameters], lr=recipe.learning_rate, eps=recipe.adam_eps, fused=True
        )
        # Sequence lengths depend on where episodes begin, so recurrent networks are not compiled.
        compiled = not recipe.is_recurrent and should_compile(recipe.compile, recipe.gradient_steps)
        self.objective: Callable[[TensorDict], tuple[Tensor, Tensor]] = self._objective
        if compiled:
            self.objective = compile_and_time(self._objective, "the loss")
        if compiled and agent.backbone.keeps_frames:
            agent.backbone.compile_parts(**STATIC_SHAPES)
        self.collector = make_collector(
            recipe, agent.policy, agent.backbone, step, compiled=compiled
        )

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, running scales and the learning rate's factor."""
        return {
            "optimizer": self.optimizer,
            "return_scale": self.return_scale,
            "advantage_scale": self.advantage_scale,
            "rate": self.rate,
        }

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields collected batches, [envs, time]."""
        for batch in self.collector:
            # Several synchronous collectors yield [collectors, envs, time].
            yield batch.flatten(0, 1) if batch.ndim == 3 else batch

    def size(self, batch: TensorDictBase) -> int:
        """The number of environment steps."""
        return batch.numel()

    def returns(self, batch: TensorDictBase) -> Tensor:
        """Returns of the episodes that ended in a batch."""
        return finished_returns(batch)

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor | float]:
        """Estimates advantages, then takes a gradient step on each minibatch of each epoch."""
        recipe, agent = self.recipe, self.agent
        learning_rate = recipe.learning_rate_at(step) * self.rate.factor
        self._set_learning_rate(learning_rate)
        left = 1 - step / recipe.final_step
        if recipe.decay_clip_epsilon:
            self.loss.clip_epsilon.fill_(recipe.clip_epsilon * left)
        if recipe.decay_entropy_coeff:
            self.loss.entropy_coeff.fill_(recipe.entropy_coeff * left)
        reward = batch["next", "reward"]
        reward = reward.sign() if recipe.clip_rewards else reward
        batch["next", "reward"] = reward * recipe.reward_scale
        if recipe.normalize_rewards:
            scale = self.return_scale.update(batch["next", "reward"], batch["next", "done"])
            batch["next", "reward"] = standardize(batch["next", "reward"], 0.0, scale, eps=1e-4)
        rollout = agent.rollout(batch)
        with torch.no_grad():
            add_advantages(batch, rollout, agent, self.gae, recipe.bootstrap_time_limit)
        target, value = batch["value_target"], batch["state_value"]
        floor = recipe.advantage_floor
        if recipe.running_advantage_floor:
            running = self.advantage_scale.update(batch["advantage"])
            floor = max(floor, recipe.running_advantage_floor * running)
        agent.train()
        steps: list[Tensor] = []
        kl = TERMS.index("kl_approx")
        per_epoch = math.ceil(batch.numel() / recipe.minibatch_size)
        for minibatch in minibatches(batch, rollout, agent, recipe):
            if not self.loss.normalize_advantage:
                minibatch["advantage"] = normalize_advantages(minibatch["advantage"], floor)
            try:
                steps.append(self._step(minibatch))
            except RuntimeError:  # TorchRL draws samples where an entropy is not finite
                self._check_update(steps)
                raise
            if recipe.target_kl is not None and len(steps) % per_epoch == 0:
                moved = torch.stack(steps[-per_epoch:])[:, kl].mean().item()
                if recipe.at_target_kl == "adapt":
                    self.rate.update(moved)
                    self._set_learning_rate(recipe.learning_rate_at(step) * self.rate.factor)
                elif moved > recipe.target_kl:
                    break
        agent.eval()
        self._check_update(steps)
        terms = torch.stack(steps)  # [gradient steps, terms]
        agent.update_statistics(rollout)
        if recipe.collectors > 1 or recipe.ray is not None:
            self.collector.update_policy_weights_()
        # If this goes to 0, the features are the same in all states, and so is the policy.
        features = batch[agent.backbone.features_keys[0]].flatten(0, -2)  # [steps, features]
        return {
            "learning_rate": learning_rate,
            "feature_spread": features.std(0).mean(),
            "explained_variance": 1 - (target - value).var() / target.var().clamp(min=1e-12),
            "epochs": len(steps) / per_epoch,
            **dict(zip(self.terms, terms.mean(0), strict=True)),
        }

    def play(self, step: int) -> list[Outcome]:
        """Plays full episodes, each with its own seed: the most likely action, raw rewards."""
        seed, episodes = self.recipe.evaluation_seed, self.recipe.evaluation_episodes
        returns = evaluate(self.make_env, self.policy, episodes, seed=seed)
        return [Outcome(step, returns.tolist())]

    def check(self) -> None:
        """Lets the policy act once in the task."""
        recipe = self.recipe
        check_compiler(recipe.compile)
        check_cluster(recipe.ray, recipe.collectors, recipe.threads)
        env = self.make_env(1, recipe.seed, vectorization_mode=recipe.vectorization_mode)
        with closing(env), torch.no_grad():
            self.policy(env.reset())

    def close(self) -> None:
        """Closes environments and processes."""
        self.collector.shutdown()

    def _step(self, minibatch: TensorDict) -> Tensor:
        """Takes a gradient step; returns its terms, float [terms]."""
        total, values = self.objective(minibatch)
        assert self.parameters.grad is not None
        self.parameters.grad.zero_()  # the gradients of all layers are views of it
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.recipe.max_grad_norm)
        self.optimizer.step()
        return torch.cat([values, norm.unsqueeze(0)])

    def _set_learning_rate(self, learning_rate: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate

    def _objective(self, minibatch: TensorDict) -> tuple[Tensor, Tensor]:
        """The loss, float [], and its terms, float [terms]."""
        self.agent.encode(minibatch)  # once; the heads read its features
        terms = self.loss(minibatch)
        # TorchRL's estimate of the divergence, mean(-log r), can be negative. Schulman's,
        # mean((r - 1) - log r), cannot (http://joschu.net/blog/kl-approx.html).
        terms["kl_approx"] += terms["mean_ratio"] - 1
        total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
        values = [terms[name].detach() for name in TERMS]
        if self.recipe.contrastive_coeff:
            contrast = self._contrastive_loss(minibatch.flatten(0, minibatch.ndim - 1))
            total = total + self.recipe.contrastive_coeff * contrast
            values.append(contrast.detach())
        return total, torch.stack(values)

    def _contrastive_loss(self, steps: TensorDict) -> Tensor:
        """CoBERL's contrastive loss, in a separate pass, because its attention is bidirectional."""
        backbone = self.agent.backbone
        histories = [steps[key] for key in backbone.history_keys]
        draws = torch.rand(histories[0].shape[:2], device=histories[0].device)
        mask = draws < self.recipe.masked_fraction
        predictions = masked_predictions(backbone.module, histories, mask)
        return contrastive_prediction_loss(*predictions, mask)

    def _check_update(self, steps: list[Tensor]) -> None:
        """Checks the terms of gradient steps, and the weights."""
        if steps:
            terms = torch.stack(steps)  # [gradient steps, terms]
            first = terms.isfinite().all(1).int().argmin()  # the first that is not finite, if any
            check_finite(self.terms, terms[first])
        check_finite(["weights"], self.parameters.detach().norm().unsqueeze(0))


def add_advantages(
    batch: TensorDictBase, rollout: Rollout, agent: Agent, gae: GAE, bootstrap_time_limit: bool
) -> None:
    """Writes ``advantage`` and ``value_target`` = advantage + value into a batch.

    The value of the next state is the one that the collector computed a step later, except where
    a time limit or the batch cuts an episode off: there the critic evaluates the true next
    observation. Where an episode terminates, nothing follows, and the value is 0.

    Args:
        batch: [envs, time], with the values of its states.
        rollout: its observations.
        agent: the agent whose critic is used.
        gae: TorchRL's estimator, which stops at terminations and continues at time limits.
        bootstrap_time_limit: if off, a time limit counts as a termination.
    """
    if not bootstrap_time_limit:
        batch["next", "terminated"] = batch["next", "done"]
    terminated = batch["next", "terminated"]
    next_value = batch["state_value"].roll(-1, dims=1).masked_fill(terminated, 0)  # [envs, time, 1]
    cut_off = rollout.ends & ~terminated.squeeze(-1)
    if cut_off.any():
        states = batch["next"][cut_off].select(*agent.state_keys)
        next_value[cut_off] = next_values(rollout, cut_off, states, agent)
    batch["next", "state_value"] = next_value
    gae(batch)


def next_values(rollout: Rollout, steps: Tensor, states: TensorDictBase, agent: Agent) -> Tensor:
    """Evaluates true next states.

    Args:
        rollout: the observations.
        steps: the E steps before these states, among ``rollout.ends``, bool [envs, time].
        states: the network's state there, if it carries one, [E].
        agent: the agent whose critic is used.

    Returns:
        float [E, 1].
    """
    backbone, values, start = agent.backbone, [], 0
    for frames, windows in rollout.next_windows(steps):
        samples = states[start : start + len(windows.rows)]
        start += len(samples)
        if backbone.is_recurrent:
            histories = [windows.gather(table) for table in frames]
            backbone(_set_all(samples, backbone.history_keys, histories))
        else:
            features = backbone.encode_windows(frames, windows)
            samples.update(dict(zip(backbone.features_keys, features, strict=True)))
        values.append(agent.critic(samples)["state_value"])
    return torch.cat(values)


def minibatches(
    batch: TensorDictBase, rollout: Rollout, agent: Agent, recipe: PPO
) -> Iterator[TensorDict]:
    """Yields shuffled minibatches of a batch, ``recipe.epochs`` times over.

    Args:
        batch: [envs, time].
        rollout: its observations.
        agent: the agent, whose backbone determines the entries.
        recipe: the settings.

    Yields:
        Sequences of consecutive steps [N, time], or single steps [N] if the network reads one frame
        and carries no state.
    """
    steps = batch.select(*agent.step_keys).reshape(-1)
    history_keys = agent.backbone.history_keys
    numbers = torch.arange(len(steps), device=steps.device)
    if not recipe.reads_sequences:
        _set_all(steps, history_keys, rollout.histories(numbers))
        for _ in range(recipe.epochs):
            order = torch.randperm(len(steps), device=steps.device)
            yield from steps[order].split(recipe.minibatch_size)
        return
    length = recipe.steps_per_sequence
    sequences = numbers.view(-1, length)
    for _ in range(recipe.epochs):
        order = torch.randperm(len(sequences), device=steps.device)
        for index in order.split(recipe.minibatch_size // length):
            chosen = sequences[index]
            minibatch = steps[chosen]
            if rollout.num_frames > 1:
                observation_keys = agent.backbone.sequence_keys.observations
                _set_all(minibatch, observation_keys, rollout.observations(chosen))
                minibatch["is_init"] = rollout.is_init[chosen].unsqueeze(-1)
            if rollout.num_frames == 1 or recipe.contrastive_coeff:
                histories = rollout.histories(chosen)
            else:  # the other windows of a sequence follow from the first one
                first = rollout.histories(chosen[:, :1])
                histories = [x.expand(-1, length, *x.shape[2:]) for x in first]
            yield _set_all(minibatch, history_keys, histories)


def _set_all(
    samples: TensorDictBase, keys: Sequence[NestedKey], tensors: Sequence[Tensor]
) -> TensorDictBase:
    """Sets several entries, and returns the samples."""
    for key, tensor in zip(keys, tensors, strict=True):
        samples.set(key, tensor)
    return samples
