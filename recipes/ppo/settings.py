"""Settings of PPO; the algorithm is in algorithm.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torchrl_tit.settings import CoBERL
from torchrl_tit.settings.checks import check_at_least
from torchrl_tit.settings.numbers import (
    Batch,
    Copies,
    Fraction,
    Positive,
    Rate,
    Real,
    Steps,
    StepsOrNone,
    Weight,
)

from ..online_recipe import OnlineRecipe
from ..ray_cluster import check_address
from ..recipe import Compile, Padding, Precision

VectorizationMode = Literal["sync", "async"]

# Longer sequences are faster, but their steps are more correlated.
_LONGEST = 16


@dataclass(frozen=True, kw_only=True)
class PPO(OnlineRecipe, algorithm="ppo"):
    """Proximal policy optimisation (arXiv 1707.06347) with Stable-Baselines3's settings.

    The defaults are those of the paper's runs on arrays (arXiv 2212.14538, appendix).
    """

    removed: ClassVar[dict[str, Any]] = {
        "async_collection": False,
        "next_frame_coeff": 0.0,
        "normalize_values": False,
        "policy_gain": 0.01,
        "reconstruction_coeff": 0.0,
        "residual_gain": 1.0,
        "value_gradient": 1.0,
    }

    padding: Padding = "same"
    """What fills a history before the first observation: that observation, or zeros."""
    hide_velocities: bool = False
    """Whether to remove velocities from observations, so that one observation is not enough."""
    mask_actions: bool = False
    """Whether the policy chooses only actions that the task's action_mask allows."""
    num_envs: Copies = 1
    """Number of environments; they share the steps of a batch."""
    vectorization_mode: VectorizationMode = "sync"
    """Whether environments run in this process ("sync") or in one process each ("async", for slow
    tasks)."""
    total_steps: Steps = 100_000
    """Environment steps to train for, rounded up to whole batches."""
    steps_per_batch: Batch = 2048
    """Environment steps collected before each update; must be a multiple of num_envs."""
    minibatch_size: Batch = 64
    """Steps in one gradient step."""
    sequence_length: Batch | None = None
    """Length of the sequences of consecutive steps that make up a minibatch, for networks that read
    several frames or carry a state; others train on single steps. Within a sequence, each frame is
    encoded once for all steps that read it. Must divide minibatch_size and an environment's steps
    in a batch; by default the largest divisor of both and of 16."""
    epochs: Steps = 10
    """Passes over each batch."""
    learning_rate: Rate = 3e-4
    """Learning rate of Adam, before it is scaled by warm-up and decay."""
    decay_learning_rate: bool = False
    """Whether the learning rate falls linearly to 0 over the run."""
    warmup_steps: StepsOrNone = 0
    """Environment steps over which the learning rate rises linearly from 0."""
    adam_eps: Weight = 1e-5
    """Epsilon of Adam."""
    max_grad_norm: Weight = 0.5
    """Maximum gradient norm; larger gradients are scaled down to it."""
    clip_epsilon: Fraction = 0.2
    """Clipping range of the probability ratio, before it decays."""
    decay_clip_epsilon: bool = False
    """Whether the clipping range falls linearly to 0 over the run."""
    entropy_coeff: Real = 0.0
    """Weight of the entropy bonus, before it decays."""
    decay_entropy_coeff: bool = False
    """Whether that weight falls linearly to 0 over the run."""
    critic_coeff: Positive = 0.5
    """Weight of the mean squared value error."""
    contrastive_coeff: Weight = 0.0
    """Weight of CoBERL's contrastive loss (arXiv 2107.05431 uses 1); 0 for other networks."""
    masked_fraction: Fraction = 0.15
    """Share of the steps that the contrastive loss masks."""
    clip_rewards: bool = False
    """Whether to train on the signs of rewards; reported returns are always unclipped."""
    reward_scale: Weight = 1.0
    """Factor on the rewards for training. If policy and value share a backbone, values in the tens
    or hundreds make its features the same in all states (docs/results/classic_control.md).
    Reported returns are always unscaled."""
    normalize_rewards: bool = False
    """Whether rewards are divided by the running standard deviation of the discounted return, as
    in VecNormalize of Stable-Baselines3 (arXiv 2005.12729, "reward scaling")."""
    advantage_floor: Weight = 0.0
    """Lower bound on the standard deviation by which a minibatch's advantages are divided. With 0,
    advantages that are almost pure noise, as on a solved task, move the policy as far as any
    others. With normalize_rewards, 1 is the standard deviation of the discounted return (DreamerV3
    also divides by at least 1, arXiv 2301.04104)."""
    running_advantage_floor: Weight = 0.0
    """The same, as a fraction of the running standard deviation of the advantages of all batches so
    far, for tasks whose advantages differ in scale. The larger of the two floors applies."""
    normalize_observations: bool = False
    """Whether the network reads observations normalised to a running mean of 0 and standard
    deviation of 1, per entry of an array and per channel of an image (as in VecNormalize; arXiv
    2006.05990, "observation normalization"). The observations of a batch are added after its
    update, so the first batch is read as it is."""
    target_kl: Positive | None = None
    """Target KL divergence of an update, estimated by the mean of (r - 1) - log r over the ratios r
    of an epoch, as in Stable-Baselines3; see at_target_kl."""
    at_target_kl: Literal["stop", "adapt"] = "stop"
    """With a target_kl: "stop" ends an update after the epoch that exceeds it (as in OpenAI's
    Spinning Up), "adapt" adjusts the learning rate to approach it (as in rl_games and skrl)."""
    gamma: Fraction = 0.99
    """Discount factor."""
    gae_lambda: Fraction = 0.95
    """Lambda of generalised advantage estimation (arXiv 1506.02438)."""
    bootstrap_time_limit: bool = True
    """Whether to bootstrap from the value of the last state when a time limit truncates an episode.
    The paper's runs (SB3 1.3.0) treated time limits as terminations."""
    initialization: Literal["orthogonal", "own"] = "orthogonal"
    """Initialisation of the backbone: orthogonal, as in Stable-Baselines3 and so in the paper's
    online runs, or the network's own (TIT: normal with a standard deviation of 0.02)."""
    checkpoint_interval: Steps = 10_240
    """Environment steps between checkpoints."""
    collectors: Copies = 1
    """Number of processes that collect, each with its share of the environments; 1 collects in the
    training process, unless ray is set. Use several for slow environments."""
    ray: str | None = None
    """Address of a Ray cluster whose machines the collectors run on: auto, or HOST:PORT. See
    docs/recipes.md."""
    compile: Compile = "auto"
    """Whether collection and update run through torch.compile, which needs a C++ compiler and about
    a minute at the start. "auto" compiles if that works and the run is long enough to be worth it.
    Recurrent networks are never compiled."""
    precision: Precision = "auto"
    """Dtype of the backbone's matrix products. "auto" is bfloat16 on a GPU that supports it, else
    float32. Weights, heads and losses are float32."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import PPOAlgorithm

        return PPOAlgorithm(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps_per_batch < 2:
            raise ValueError(f"steps_per_batch must be at least 2, not {self.steps_per_batch}")
        check_at_least(self, minibatch_size=2)  # a single advantage has no standard deviation
        _check_divides(self, "num_envs", "steps_per_batch", self.steps_per_batch)
        _check_divides(self, "collectors", "num_envs", self.num_envs)
        if self.contrastive_coeff and not isinstance(self.backbone.history, CoBERL):
            raise ValueError(
                "contrastive_coeff is the weight of a loss that only coberl has: set it to 0 for "
                "other history encoders"
            )
        if self.reads_sequences and self.sequence_length is not None:
            steps = self.steps_per_batch // self.num_envs
            _check_divides(self, "sequence_length", "minibatch_size", self.minibatch_size)
            _check_divides(self, "sequence_length", "steps_per_batch / num_envs", steps)
        if self.is_recurrent and self.precision == "bfloat16":
            raise ValueError("precision is bfloat16, but a recurrent network computes in float32")
        check_address(self)

    @property
    def is_recurrent(self) -> bool:
        """Whether the network carries a state from step to step."""
        return self.backbone.carries_state

    @property
    def reads_sequences(self) -> bool:
        """Whether minibatches consist of sequences, and not of single steps."""
        return self.is_recurrent or self.backbone.num_frames > 1

    @property
    def steps_per_sequence(self) -> int:
        """``sequence_length``, or its default; 1 where it does not apply."""
        if not self.reads_sequences:
            return 1
        steps = self.steps_per_batch // self.num_envs
        return self.sequence_length or math.gcd(_LONGEST, self.minibatch_size, steps)

    @property
    def final_step(self) -> int:
        """``total_steps``, rounded up to whole batches."""
        return math.ceil(self.total_steps / self.steps_per_batch) * self.steps_per_batch

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


def _check_divides(recipe: PPO, field: str, name: str, value: int) -> None:
    """Raises ValueError if a field does not divide a value."""
    if value % getattr(recipe, field):
        raise ValueError(
            f"{field} {getattr(recipe, field)} does not divide {name} {value}: change one of them"
        )
