"""PPO with any backbone of the house: the settings. The loop is in training.py."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_tit.envs import VectorizationMode, make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import LSTMConfig
from torchrl_tit.networks import CoBERLConfig

from ..compilation import Compile, Precision, compile_options, should_compile
from ..recipe import Recipe, check_at_least, check_at_most
from ..run import Run
from .agent import Agent
from .training import train


@dataclass(frozen=True, kw_only=True)
class PPO(Recipe):
    """Proximal policy optimisation (arXiv 1707.06347) as Stable-Baselines3 sets it.

    The defaults are those of the paper's runs on arrays (arXiv 2212.14538, appendix).
    """

    algorithm: ClassVar[str] = "ppo"

    env: str
    """Name of a Gymnasium environment."""
    history: int = 1
    """Number K of observations that the network sees."""
    padding: Literal["same", "constant"] = "same"
    """What stands before an episode's first observation: that observation, or zeros."""
    hide_velocities: bool = False
    """Whether the velocities are left out of the observations, so that one says too little."""
    num_envs: int = 1
    """Environments that are stepped side by side; they share the steps of a batch."""
    vectorization_mode: VectorizationMode = "sync"
    """Whether training steps them in this process or in one each, which pays for slow tasks."""
    total_steps: int = 100_000
    """Environment steps to train for, rounded up to whole batches."""
    steps_per_batch: int = 2048
    """Environment steps that are collected before each update; must be a multiple of num_envs."""
    minibatch_size: int = 64
    """Steps in one gradient step."""
    sequence_length: int = 16
    """Consecutive steps that a recurrent network is trained on at a time; must divide the steps of
    an environment in a batch, and minibatch_size. Other networks are trained on single steps."""
    epochs: int = 10
    """Passes over each batch."""
    learning_rate: float = 3e-4
    """Learning rate of Adam, before it is scaled by warm-up and decay."""
    decay_learning_rate: bool = False
    """Whether the learning rate falls linearly to 0 over the run."""
    warmup_steps: int = 0
    """Environment steps over which the learning rate rises linearly from 0."""
    adam_eps: float = 1e-5
    """Epsilon of Adam."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this norm."""
    clip_epsilon: float = 0.2
    """How far the probability ratio may move, at the start where it decays."""
    decay_clip_epsilon: bool = False
    """Whether the clipping range falls linearly to 0 over the run."""
    entropy_coeff: float = 0.0
    """Weight of the entropy bonus."""
    critic_coeff: float = 0.5
    """Weight of the mean squared value error."""
    contrastive_coeff: float = 0.0
    """Weight of the contrastive loss of CoBERL (arXiv 2107.05431: 1); other networks have none."""
    masked_fraction: float = 0.15
    """Share of the steps that the contrastive loss hides."""
    clip_rewards: bool = False
    """Whether training sees the rewards' signs only; returns are always those of the task."""
    reward_scale: float = 1.0
    """Rewards are multiplied by this for training. Where policy and value share a backbone, values
    in the tens or hundreds drive its features to be the same in all states
    (docs/results/classic_control.md); returns are always those of the task."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation (arXiv 1506.02438)."""
    bootstrap_time_limit: bool = True
    """Whether an episode cut by a time limit goes on in its value. The paper's runs (SB3 1.3.0)
    took the cut for a termination."""
    initialization: Literal["orthogonal", "own"] = "orthogonal"
    """How the backbone starts: orthogonal, as Stable-Baselines3 made every network that the paper
    trained online, or as the network's own paper says (TIT: normal with 0.02)."""
    checkpoint_interval: int = 10_240
    """Environment steps between checkpoints."""
    collectors: int = 1
    """Processes that act side by side, each with its share of the environments; 1 acts in the
    training process. They pay for slow environments. A run of several can be resumed, but then acts
    with other random numbers than one that never stopped."""
    async_collection: bool = False
    """Whether several collectors go on acting during updates: a batch is then that of one of them,
    and up to one update behind."""
    compile: Compile = "auto"
    """Whether acting and the update run through torch.compile, which needs a C++ compiler and about
    a minute at the start: "auto" is on where it works and the run is long enough to earn that
    back. Recurrent networks are never compiled."""
    compile_optimizer: Compile = "auto"
    """Whether the gradient's norm and Adam are compiled too: "auto" is on on a GPU, where the rest
    is compiled. On a processor Adam's own kernel is faster."""
    cuda_graphs: Compile = "auto"
    """Whether a GPU launches what is compiled as CUDA graphs; "auto" is on."""
    precision: Precision = "auto"
    """What the backbone's matrix products are computed in: "auto" is bfloat16 on a GPU that has it
    and float32 elsewhere. Weights, heads and losses are float32."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            history=1,
            num_envs=1,
            collectors=1,
            total_steps=1,
            sequence_length=1,
            minibatch_size=2,  # an advantage alone has no standard deviation
            epochs=1,
            learning_rate=0,
            warmup_steps=0,
            contrastive_coeff=0,
            masked_fraction=0,
            adam_eps=0,
            max_grad_norm=0,
            clip_epsilon=0,
            reward_scale=0,
            gamma=0,
            gae_lambda=0,
            checkpoint_interval=1,
        )
        check_at_most(self, clip_epsilon=1, gamma=1, gae_lambda=1, masked_fraction=1)
        if self.steps_per_batch < 2 or self.steps_per_batch % self.num_envs:
            raise ValueError(
                f"steps_per_batch {self.steps_per_batch} cannot be shared by {self.num_envs} "
                "environments: it must be a multiple of num_envs"
            )

        if not self.critic_coeff > 0:
            raise ValueError(
                f"critic_coeff must be above 0, not {self.critic_coeff}: PPO's advantages need a "
                "critic that learns"
            )
        if self.contrastive_coeff and not isinstance(self.backbone, CoBERLConfig):
            raise ValueError(
                "contrastive_coeff is the weight of a loss of coberl alone: set it to 0 for other "
                "networks"
            )
        if self.is_recurrent:
            for name, steps in (
                ("minibatch_size", self.minibatch_size),
                ("steps_per_batch / num_envs", self.steps_per_batch // self.num_envs),
            ):
                if steps % self.sequence_length:
                    raise ValueError(
                        f"sequence_length {self.sequence_length} does not divide {name} = {steps}"
                    )

        if self.num_envs % self.collectors:
            raise ValueError(
                f"num_envs {self.num_envs} cannot be shared by {self.collectors} collectors: it "
                "must be a multiple of collectors"
            )
        if self.is_recurrent and self.precision == "bfloat16":
            raise ValueError("precision is bfloat16, but a recurrent network computes in float32")
        if self.async_collection and self.collectors == 1:
            raise ValueError("async_collection is on, but there is one collector: set collectors")

    @property
    def is_recurrent(self) -> bool:
        """Whether the network carries a state from step to step."""
        return isinstance(self.backbone, LSTMConfig)

    @property
    def final_step(self) -> int:
        """``total_steps``, rounded up to whole batches."""
        return math.ceil(self.total_steps / self.steps_per_batch) * self.steps_per_batch

    @property
    def gradient_steps(self) -> int:
        """Gradient steps of the whole run."""
        batches = self.final_step // self.steps_per_batch
        return batches * self.epochs * math.ceil(self.steps_per_batch / self.minibatch_size)

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of the update that follows the batch up to a step."""
        begun = step - self.steps_per_batch
        rise = min(1, step / self.warmup_steps) if self.warmup_steps else 1
        fall = 1 - begun / self.final_step if self.decay_learning_rate else 1
        return self.learning_rate * rise * fall

    def make_env(self, num_envs: int, seed: int, **kwargs: Any) -> EnvBase:
        """Builds the environment, with the history as part of it; settings go to the task."""
        device = self.torch_device()
        env = make_env(
            self.env,
            num_envs,
            seed=seed,
            history=self.history,
            padding=self.padding,
            hide_velocities=self.hide_velocities,
            device=None if device.type == "cpu" else device,
            **kwargs,
        )
        if isinstance(self.backbone, LSTMConfig):
            env = TransformedEnv(env, self.backbone.make_transforms(), auto_unwrap=True)
        return env

    def check(self) -> None:
        """Builds environment and agent once and lets it act.

        Raises:
            ValueError: if they cannot be built as the fields say, or do not fit each other.
        """
        should_compile(self.compile, self.gradient_steps)
        should_compile(self.compile_optimizer, self.gradient_steps)
        compile_options(self.cuda_graphs, self.torch_device())
        try:
            env = self.make_env(1, self.seed, vectorization_mode=self.vectorization_mode)
            with closing(env):
                Agent(self, env).policy(env.reset())
        except TypeError as error:  # a kind of observation, say, that no network here reads
            raise ValueError(str(error)) from error

    def train(self, run: Run) -> None:
        """Trains in a run folder; see :func:`train`."""
        train(self, run)

    def evaluate(self, run: Run) -> dict[str, Any]:
        """Evaluates a run's newest checkpoint: full episodes, the most likely action, raw rewards.

        Args:
            run: a run folder with a checkpoint.

        Returns:
            ``returns`` of the episodes, their ``mean`` and ``std`` (population), ``episodes``,
            ``seed`` of the first episode, ``env``, and ``steps`` that the agent was trained for.

        Raises:
            FileNotFoundError: if there is no checkpoint.
        """
        step, agent = self.load_agent(run)
        returns = evaluate(
            lambda num_envs: self.make_env(num_envs, self.evaluation_seed),
            agent.policy,
            self.evaluation_episodes,
            seed=self.evaluation_seed,
        )
        return {
            "mean": returns.mean().item(),
            "std": returns.std(correction=0).item(),
            "episodes": len(returns),
            "seed": self.evaluation_seed,
            "env": self.env,
            "steps": step,
            "returns": returns.tolist(),
        }

    def load_player(self, run: Run, **settings: Any) -> tuple[TensorDictModuleBase, EnvBase]:
        """As :meth:`Recipe.load_player`."""
        _, agent = self.load_agent(run)
        return agent.eval().policy, self.make_env(1, self.evaluation_seed, **settings)

    def load_agent(self, run: Run) -> tuple[int, Agent]:
        """Loads the agent of a run's newest checkpoint.

        Args:
            run: a run folder with a checkpoint.

        Returns:
            The steps that it was trained for, and the agent.

        Raises:
            FileNotFoundError: if there is no checkpoint.
        """
        step, state = run.load_trained()
        torch.set_num_threads(self.threads)
        agent = Agent(self, self.make_env(1, self.evaluation_seed))
        with run.restoring(step):
            agent.load_state_dict(state["agent"])
        return step, agent
