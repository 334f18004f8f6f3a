"""PPO with any network: collect a batch, estimate advantages, update on minibatches.

Settings first, then the algorithm, in the order in which a batch passes through it. To change it,
subclass both and override one of ``networks``, ``collected``, ``advantages`` and ``loss``:
docs/how-to/change-ppo.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_tit.envs import observation_specs
from torchrl_tit.envs.action_masks import MASK
from torchrl_tit.frames.normalized import NormalizedFrames
from torchrl_tit.layers import init_orthogonal_, standardize
from torchrl_tit.modules import Backbone, history_keys, make_actor, make_value
from torchrl_tit.modules.backbone import trunks_of
from torchrl_tit.networks import build_network
from torchrl_tit.rollout import FrameCollector, Rollout
from torchrl_tit.settings.numbers import (
    Batch,
    Fraction,
    Positive,
    Rate,
    Real,
    Steps,
    StepsOrNone,
    Weight,
)
from torchrl_tit.windows import Windows, take

from .core.adaptive import AdvantageScale, ReturnScale, normalize_advantages
from .core.algorithm import Stateful, check_finite
from .core.compilation import (
    STATIC_SHAPES,
    check_compiler,
    compile_and_time,
    should_compile,
)
from .core.networks import normalize_frames
from .core.recipe import Compile
from .core.task import make_task
from .online import OnlineAlgorithm, OnlineRecipe

# Longer sequences are faster, but their steps are correlated: a minibatch of windows consists of
# this many sequences at least. Through a state, gradients reach as far as a sequence is long.
_LONGEST = _SEQUENCES = 16


@dataclass(frozen=True, kw_only=True)
class PPO(OnlineRecipe, algorithm="ppo"):
    """Proximal policy optimization (arXiv 1707.06347) with Stable-Baselines3's settings.

    The defaults are those of the paper's runs on arrays (arXiv 2212.14538, appendix).
    """

    removed: ClassVar[dict[str, Any]] = {
        "async_collection": False,
        "at_target_kl": "stop",
        "bootstrap_time_limit": True,
        "contrastive_coeff": 0.0,
        "masked_fraction": 0.15,
        "next_frame_coeff": 0.0,
        "normalize_values": False,
        "policy_gain": 0.01,
        "precision": "auto",
        "reconstruction_coeff": 0.0,
        "residual_gain": 1.0,
        "value_gradient": 1.0,
        "vectorization_mode": "sync",
    }

    mask_actions: bool = False
    """Whether the policy chooses only actions that the task's action_mask allows."""
    minibatch_size: Batch = 64
    """Steps in one gradient step."""
    sequence_length: Batch | None = None
    """Length of the sequences of consecutive steps that make up a minibatch, for networks that read
    several frames or carry a state; others train on single steps. Within a sequence, each frame is
    encoded once for all steps that read it. Must divide minibatch_size and an environment's steps
    in a batch; by default it divides 16, too, and without a state a 16th of minibatch_size, so that
    a minibatch holds 16 sequences or more."""
    epochs: Steps = 10
    """Passes over each batch."""
    learning_rate: Rate = 3e-4
    """Learning rate of Adam, before it is scaled by warm-up and decay."""
    decay_learning_rate: bool = False
    """Whether the learning rate falls linearly to 0 over the run. The first update has all of it;
    Stable-Baselines3 counts the steps of its batch already, and is an update ahead."""
    warmup_steps: StepsOrNone = 0
    """Environment steps over which the learning rate rises linearly from 0."""
    adam_eps: Weight = 1e-5
    """Epsilon of Adam."""
    max_grad_norm: Weight = 0.5
    """Maximum gradient norm; larger gradients are scaled down to it."""
    clip_epsilon: Fraction = 0.2
    """Clipping range of the probability ratio, before it decays."""
    decay_clip_epsilon: bool = False
    """Whether the clipping range falls linearly to 0 over the run, as the learning rate does."""
    entropy_coeff: Real = 0.0
    """Weight of the entropy bonus, before it decays."""
    decay_entropy_coeff: bool = False
    """Whether that weight falls linearly to 0 over the run."""
    critic_coeff: Positive = 0.5
    """Weight of the mean squared value error."""
    clip_rewards: bool = False
    """Whether to train on the signs of rewards; reported returns are always unclipped."""
    reward_scale: Weight = 1.0
    """Factor on the rewards for training. If policy and value share a backbone, values in the tens
    or hundreds make its features the same in all states (docs/results/classic_control.md).
    Reported returns are always unscaled."""
    normalize_rewards: bool = False
    """Whether rewards are divided by the running standard deviation of the discounted return, as
    in VecNormalize of Stable-Baselines3, which also clips the result to +-10 (arXiv 2005.12729,
    "reward scaling")."""
    advantage_floor: Weight = 0.0
    """Lower bound on the standard deviation by which a minibatch's advantages are divided. With 0,
    advantages that are almost pure noise, as on a solved task, move the policy as far as any
    others. With normalize_rewards, 1 is the standard deviation of the discounted return (DreamerV3
    also divides by at least 1, arXiv 2301.04104)."""
    running_advantage_floor: Weight = 0.0
    """The same, as a fraction of the running standard deviation of the advantages of all batches so
    far, for tasks whose advantages differ in scale. The larger of the two floors applies."""
    normalize_observations: bool = False
    """Whether the network reads observations normalized to a running mean of 0 and standard
    deviation of 1, per entry of an array and per pixel of an image (as in VecNormalize; arXiv
    2006.05990, "observation normalization"). The observations of a batch are added after its
    update, so the first batch is read as it is."""
    target_kl: Positive | None = None
    """Target KL divergence of an update, estimated by the mean of (r - 1) - log r over the ratios r
    of an epoch, as in Stable-Baselines3. An update ends after the epoch that exceeds it, as in
    OpenAI's Spinning Up."""
    gae_lambda: Fraction = 0.95
    """Lambda of generalized advantage estimation (arXiv 1506.02438)."""
    initial_std: Positive | None = None
    """Standard deviation of continuous actions at the start, as a share of half the range of each
    entry (0.5 in arXiv 2006.05990); by default 1 in its own units, as in Stable-Baselines3. It can
    only fall as fast as Adam's learning rate allows. Discrete actions have none. State-dependent
    noise (`ppo-gsde`) begins so for features with a mean square of 1; an MLP has smaller ones."""
    initialization: Literal["orthogonal", "own"] = "orthogonal"
    """Initialization of the backbone: orthogonal, as in Stable-Baselines3 and so in the paper's
    online runs, or the network's own (TIT: normal with a standard deviation of 0.02)."""
    checkpoint_interval: Steps = 10_240
    """Environment steps between checkpoints."""
    compile: Compile = "auto"
    """Whether collection and update run through torch.compile, which needs a C++ compiler and about
    a minute at the start. "auto" compiles if that works and the run is long enough to be worth it.
    Recurrent networks are never compiled."""
    bfloat16: bool = False
    """Whether the backbone's matrix products are in bfloat16; weights, heads and losses are
    float32. On an H200, networks of the paper's sizes were slower with it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("steps_per_batch", "minibatch_size"):
            if getattr(self, field) < 2:  # a single advantage has no standard deviation
                raise ValueError(f"{field} must be at least 2, not {getattr(self, field)}")
        if self.reads_sequences and self.sequence_length is not None:
            steps = self.steps_per_batch // self.num_envs
            self.check_divides("sequence_length", "minibatch_size", self.minibatch_size)
            self.check_divides("sequence_length", "steps_per_batch / num_envs", steps)
        if self.backbone.carries_state and self.bfloat16:
            raise ValueError("bfloat16 is on, but a recurrent network computes in float32")

    def build(self) -> PPOAlgorithm:
        """Builds the algorithm."""
        return PPOAlgorithm(self)

    @property
    def reads_sequences(self) -> bool:
        """Whether minibatches consist of sequences, and not of single steps."""
        return self.backbone.carries_state or self.backbone.num_frames > 1

    @property
    def steps_per_sequence(self) -> int:
        """``sequence_length``, or its default; 1 where it does not apply."""
        if not self.reads_sequences:
            return 1
        steps = self.steps_per_batch // self.num_envs
        if self.sequence_length:
            return self.sequence_length
        size = self.minibatch_size
        share = size if self.backbone.carries_state else max(1, size // _SEQUENCES)
        return math.gcd(_LONGEST, share, size, steps)

    @property
    def gradient_steps(self) -> int:
        """Gradient steps of the whole run."""
        batches = self.final_step // self.steps_per_batch
        return batches * self.epochs * math.ceil(self.steps_per_batch / self.minibatch_size)

    @property
    def schedules(self) -> tuple[str, ...]:
        """What falls to 0 over the run: learning rate, clipping range, weight of the entropy."""
        fields = ("decay_learning_rate", "decay_clip_epsilon", "decay_entropy_coeff")
        return tuple(field for field in fields if getattr(self, field))

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of the update on the batch that begins at a step."""
        end = step + self.steps_per_batch
        rise = min(1, end / self.warmup_steps) if self.warmup_steps else 1
        fall = 1 - step / self.final_step if self.decay_learning_rate else 1
        return self.learning_rate * rise * fall


class Minibatch(NamedTuple):
    """N sequences of T consecutive steps, and the frames that the network reads in them."""

    steps: TensorDictBase
    """The entries of ``step_keys``, and "is_init", of each step, [N, T]."""
    frames: list[Tensor]
    """The frames of each observation, each once, [R, *observation_shape]."""
    windows: Windows
    """The rows of the K frames that the network reads in each step, [N, T, K]."""

    @property
    def observations(self) -> list[Tensor]:
        """The newest observation of each step, [N, T, *observation_shape] each, not normalized."""
        return [take(table, self.windows.rows[..., -1]) for table in self.frames]


class ActorCritic(nn.Module):
    """A backbone, and the heads that read its features.

    Args:
        backbone: reads histories or windows, and writes features.
        actor: writes the action's distribution, the action and its log-probability.
        critic: writes the value of the state.
    """

    def __init__(
        self, backbone: Backbone, actor: TensorDictModuleBase, critic: TensorDictModuleBase
    ) -> None:
        super().__init__()
        self.backbone, self.actor, self.critic = backbone, actor, critic


class PPOAlgorithm(OnlineAlgorithm[PPO]):
    """PPO as in Stable-Baselines3, on TorchRL's loss and collectors.

    Args:
        recipe: the settings.
    """

    model: ActorCritic
    terms: Sequence[str] = (
        "loss_objective",
        "loss_critic",
        "loss_entropy",
        "entropy",
        "kl_approx",
        "clip_fraction",
    )
    """The terms of :meth:`loss` whose means are metrics; a subclass adds its own."""
    step_keys: Sequence[str] = ("action", "action_log_prob", "advantage", "value_target")
    """The entries of a collected batch that minibatches carry; a subclass adds its own."""

    def __init__(self, recipe: PPO) -> None:
        super().__init__(recipe)
        with closing(make_task(recipe, clip_actions=False)) as task:  # its spec has the bounds
            self.model = self.networks(task).to(self.device)
        self.model.backbone.autocast = torch.bfloat16 if recipe.bfloat16 else None
        means = ["feature_spread", "explained_variance", "epochs", *self.terms, "gradient_norm"]
        self.columns = ["learning_rate", *means]
        self.return_scale = ReturnScale(recipe.gamma)
        self.advantage_scale = AdvantageScale()

    def networks(self, env: EnvBase) -> ActorCritic:
        """Builds the networks: backbone, actor and critic, and what a subclass adds to them.

        Args:
            env: the task, for its observations and actions.
        """
        recipe, observation = self.recipe, observation_specs(env)
        separate = recipe.backbone.trunks == "separate"
        keys = ["policy_features", "value_features"] if separate else ["features"]
        network = build_network(recipe.backbone, observation)
        histories = history_keys(observation)
        backbone = Backbone(network, in_keys=histories, out_keys=keys, padding=recipe.padding)
        if recipe.initialization == "orthogonal":
            init_orthogonal_(backbone)
        if recipe.normalize_observations:
            normalize_frames(network)
        actor = make_actor(
            backbone.features_dim,
            env.action_spec_unbatched,
            in_key=keys[0],
            mask_key=MASK if recipe.mask_actions else None,
            batch_dims=0,
            std=recipe.initial_std,
        )
        return ActorCritic(backbone, actor, make_value(backbone.features_dim, in_key=keys[-1]))

    @property
    def policy(self) -> TensorDictModuleBase:
        """Histories in; features, action, its log-probability and the state's value out."""
        return TensorDictSequential(self.model.backbone, self.model.actor, self.model.critic)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds loss, optimizer and collector."""
        recipe, model = self.recipe, self.model.eval()
        self.ppo_loss = ClipPPOLoss(
            model.actor,
            model.critic,
            clip_epsilon=recipe.clip_epsilon,
            entropy_coeff=recipe.entropy_coeff,
            critic_coeff=recipe.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=not (recipe.advantage_floor or recipe.running_advantage_floor),
            log_explained_variance=False,
            functional=False,
        )
        self.gae = GAE(gamma=recipe.gamma, lmbda=recipe.gae_lambda, value_network=None)
        trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self.parameters = flatten_parameters(trained)
        self.optimizer = torch.optim.Adam(
            [self.parameters], lr=recipe.learning_rate, eps=recipe.adam_eps, fused=True
        )
        # Sequence lengths depend on where episodes begin, so recurrent networks are not compiled.
        recurrent, keeps_frames = model.backbone.is_recurrent, model.backbone.keeps_frames
        compiled = not recurrent and should_compile(recipe.compile, recipe.gradient_steps)
        self.objective = (
            compile_and_time(self._objective, "the loss", self) if compiled else self._objective
        )
        if compiled and keeps_frames:
            model.backbone.compile_parts(**STATIC_SHAPES)
        # The tokens to reuse are chosen between two parts that are compiled separately.
        whole = compiled and not keeps_frames
        alone: dict[str, Any] = {
            "return_same_td": True,  # without buffers, each batch has its own memory
            "compile_policy": STATIC_SHAPES if whole else None,
        }
        self.collector = self.make_collector(
            self.policy,
            # Steps keep each observation once.
            partial(make_task, state=model.backbone.make_transforms(), keep_histories=False),
            step,
            FrameCollector,
            **alone if self.collects_here else {},
        )

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer and running scales."""
        return {
            "optimizer": self.optimizer,
            "return_scale": self.return_scale,
            "advantage_scale": self.advantage_scale,
        }

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields collected batches, [envs, time]."""
        for batch in self.collector:
            # Several synchronous collectors yield [collectors, envs, time].
            yield batch.flatten(0, 1) if batch.ndim == 3 else batch

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor | float]:
        """Estimates advantages, then takes a gradient step on each minibatch of each epoch."""
        recipe, model = self.recipe, self.model
        learning_rate = self._set_schedules(step)
        with torch.no_grad():
            batch = self.collected(batch)
            rollout = self.rollout(batch)
            self.advantages(batch, rollout)
        floor = recipe.advantage_floor
        if recipe.running_advantage_floor:
            running = self.advantage_scale.update(batch["advantage"])
            floor = max(floor, recipe.running_advantage_floor * running)
        target, value = batch["value_target"], batch["state_value"]
        explained_variance = 1 - (target - value).var() / target.var().clamp(min=1e-12)
        model.train()
        steps: list[Tensor] = []
        per_epoch = math.ceil(batch.numel() / recipe.minibatch_size)
        for minibatch in self.minibatches(batch, rollout):
            if not self.ppo_loss.normalize_advantage:
                advantage = minibatch.steps["advantage"]
                minibatch.steps["advantage"] = normalize_advantages(advantage, floor)
            try:
                steps.append(self._step(minibatch))
            except RuntimeError:  # TorchRL draws samples where an entropy is not finite
                self._check_update(steps)
                raise
            if recipe.target_kl is not None and len(steps) % per_epoch == 0:
                terms = torch.stack(steps[-per_epoch:]).mean(0)
                moved = terms[self.terms.index("kl_approx")].item()
                if moved > recipe.target_kl:
                    break
        model.eval()
        self._check_update(steps)
        self._update_statistics(rollout)
        if not self.collects_here:
            self.collector.update_policy_weights_()
        # If this goes to 0, the features are the same in all states, and so is the policy.
        features = batch[model.backbone.features_keys[0]].flatten(0, -2)  # [steps, features]
        return {
            "learning_rate": learning_rate,
            "feature_spread": features.std(0).mean(),
            "explained_variance": explained_variance,
            "epochs": len(steps) / per_epoch,
            **dict(zip([*self.terms, "gradient_norm"], torch.stack(steps).mean(0), strict=True)),
        }

    def rollout(self, batch: TensorDictBase) -> Rollout:
        """Arranges the frames of a collected batch, each once, and removes them from it."""
        recipe, keys = self.recipe, self.model.backbone.sequence_keys.observations
        return Rollout(batch, recipe.backbone.num_frames, recipe.padding, keys)

    def collected(self, batch: TensorDictBase) -> TensorDictBase:
        """Receives each collected batch, [envs, time], and returns it with the rewards to train on.

        Here they are clipped, scaled and normalized, as far as the recipe says so.
        """
        recipe, reward = self.recipe, batch["next", "reward"]
        reward = reward.sign() if recipe.clip_rewards else reward
        reward = reward * recipe.reward_scale
        if recipe.normalize_rewards:
            scale = self.return_scale.update(reward, batch["next", "done"])
            reward = standardize(reward, 0.0, scale, eps=1e-4)
        batch["next", "reward"] = reward
        return batch

    def advantages(self, batch: TensorDictBase, rollout: Rollout) -> None:
        """Writes "advantage" and "value_target", float [envs, time, 1], into a batch.

        Here by TorchRL's GAE, which stops at terminations and continues at time limits.

        Args:
            batch: [envs, time], with the "state_value" of its states.
            rollout: its frames.
        """
        batch["next", "state_value"] = self.next_values(batch, rollout)
        self.gae(batch)

    def next_values(self, batch: TensorDictBase, rollout: Rollout) -> Tensor:
        """Returns the value of the state after each step, float [envs, time, 1].

        It is the one that was computed a step later while collecting, except where a time limit or
        the batch cuts an episode off: there the critic evaluates the true next observation. Where
        an episode terminates, nothing follows, and the value is 0.
        """
        terminated = batch["next", "terminated"]
        values = batch["state_value"].roll(-1, dims=1).masked_fill(terminated, 0)
        cut_off = rollout.ends & ~terminated.squeeze(-1)
        states = batch["next"][cut_off].select(*self._state_keys)
        start, found = 0, []
        for frames, windows in rollout.next_windows(cut_off):
            samples = states[start : start + len(windows.rows)]
            start += len(samples)
            self._encode(samples, frames, windows, sequences=False)
            found.append(self.model.critic(samples)["state_value"])
        if found:
            values[cut_off] = torch.cat(found)
        return values

    def minibatches(self, batch: TensorDictBase, rollout: Rollout) -> Iterator[Minibatch]:
        """Yields shuffled minibatches of a batch [envs, time], ``epochs`` times over.

        They consist of sequences of consecutive steps, [N, T]; T is 1 if the network reads one
        frame and carries no state.
        """
        recipe = self.recipe
        masks = [MASK] if recipe.mask_actions else []
        steps = batch.select(*self._state_keys, *masks, *self.step_keys).reshape(-1)
        if not self._state_keys:
            steps["is_init"] = rollout.is_init.unsqueeze(-1)
        length = recipe.steps_per_sequence
        sequences = torch.arange(len(steps), device=steps.device).view(-1, length)
        for _ in range(recipe.epochs):
            order = torch.randperm(len(sequences), device=steps.device)
            for index in order.split(recipe.minibatch_size // length):
                chosen = sequences[index]
                yield Minibatch(steps[chosen], *rollout.sequences(chosen))

    def loss(self, minibatch: Minibatch) -> TensorDictBase:
        """Returns the terms of the loss, float [] each.

        Those whose names begin with "loss_" are added up and trained on. To add one, override this
        method and call it first: it writes the features into ``minibatch.steps``.
        """
        steps, frames, windows = minibatch
        self._encode(steps, frames, windows)  # once; the heads read the features
        terms = self.ppo_loss(steps)
        # TorchRL's estimate of the divergence, mean(-log r), can be negative. Schulman's,
        # mean((r - 1) - log r), cannot (http://joschu.net/blog/kl-approx.html).
        terms["kl_approx"] += terms["mean_ratio"] - 1
        return terms

    def check(self) -> None:
        """As :meth:`OnlineAlgorithm.check`; a compiler must be there if it is required."""
        check_compiler(self.recipe.compile)
        super().check()

    @property
    def _state_keys(self) -> list[str]:
        """The keys of a recurrent network's state; none for other networks."""
        states = self.model.backbone.state_shapes
        return [*states, "is_init"] if states else []

    def _encode(
        self,
        steps: TensorDictBase,
        frames: list[Tensor],
        windows: Windows,
        *,
        sequences: bool = True,
    ) -> None:
        """Writes the features of sequences [N, T], or of single steps [N]."""
        backbone = self.model.backbone
        if backbone.is_recurrent:  # it also reads the state, of each sequence's first step
            for key, table in zip(backbone.history_keys, frames, strict=True):
                steps[key] = windows.gather(table)
            with set_recurrent_mode(sequences):
                backbone(steps)
        else:
            features = backbone.encode_windows(frames, windows)
            steps.update(dict(zip(backbone.features_keys, features, strict=True)))

    def _objective(self, minibatch: Minibatch) -> tuple[Tensor, Tensor]:
        """The loss, float [], and its terms, float [terms]."""
        terms = self.loss(minibatch)
        total = sum(term for name, term in terms.items() if name.startswith("loss_"))
        return total, torch.stack([terms[name].detach() for name in self.terms])

    def _step(self, minibatch: Minibatch) -> Tensor:
        """Takes a gradient step; returns its terms and the gradient's norm, float [terms + 1]."""
        total, values = self.objective(minibatch)
        assert self.parameters.grad is not None
        self.parameters.grad.zero_()  # the gradients of all layers are views of it
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.recipe.max_grad_norm)
        self.optimizer.step()
        return torch.cat([values, norm.unsqueeze(0)])

    def _set_schedules(self, step: int) -> float:
        """Sets what changes over the run, and returns the learning rate."""
        recipe, left = self.recipe, 1 - step / self.recipe.final_step
        learning_rate = recipe.learning_rate_at(step)
        self.optimizer.param_groups[0]["lr"] = learning_rate
        if recipe.decay_clip_epsilon:
            self.ppo_loss.clip_epsilon.fill_(recipe.clip_epsilon * left)
        if recipe.decay_entropy_coeff:
            self.ppo_loss.entropy_coeff.fill_(recipe.entropy_coeff * left)
        return learning_rate

    def _update_statistics(self, rollout: Rollout) -> None:
        """Adds the observation of each step of a batch to the statistics that normalize them.

        Neither padding nor the frames before the batch are added, nor the last observation of an
        episode, in which nobody acts. A batch is collected and learned from with the same
        statistics.
        """
        for trunk in trunks_of(self.model.backbone.module).values():
            for encoder, table in zip(trunk.frames, rollout.frames, strict=True):
                if isinstance(encoder, NormalizedFrames):
                    encoder.update(table[rollout.newest])

    def _check_update(self, steps: list[Tensor]) -> None:
        """Checks the terms of gradient steps, and the weights."""
        if steps:
            terms = torch.stack(steps)  # [gradient steps, terms + 1]
            first = terms.isfinite().all(1).int().argmin()  # the first that is not finite, if any
            check_finite([*self.terms, "gradient_norm"], terms[first])
        check_finite(["weights"], self.parameters.detach().norm().unsqueeze(0))


def flatten_parameters(parameters: Sequence[nn.Parameter]) -> nn.Parameter:
    """Stores parameters in one tensor, and their gradients in another.

    The parameters keep their values and become views. For a network of small layers, the gradient
    norm, clipping and Adam's step take a third of the time if they run on this tensor alone.

    Args:
        parameters: parameters on one device and of one dtype. They must stay there: moving or
            casting a module gives it new memory.

    Returns:
        All values, float [P], with their gradients as ``grad``.

    Example:
        >>> linear = nn.Linear(2, 2)
        >>> flat = flatten_parameters(list(linear.parameters()))
        >>> flat.shape
        torch.Size([6])
        >>> linear(torch.ones(1, 2)).sum().backward()
        >>> flat.grad
        tensor([1., 1., 1., 1., 1., 1.])
    """
    flat = nn.Parameter(torch.cat([parameter.detach().flatten() for parameter in parameters]))
    flat.grad = torch.zeros_like(flat)
    sizes = [parameter.numel() for parameter in parameters]
    views = zip(parameters, flat.data.split(sizes), flat.grad.split(sizes), strict=True)
    for parameter, value, gradient in views:
        parameter.data = value.view_as(parameter)
        parameter.grad = gradient.view_as(parameter).data  # no view of its base, for autograd
    return flat
