"""Online Decision Transformer: pre-trained on a data set, then fine-tuned on its own episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import OnlineDTLoss

from torchrl_tit import settings
from torchrl_tit.datasets import (
    Episodes,
    SequenceStorage,
    episodes_from_arrays,
    join_episodes,
    make_replay_buffer,
    select_episodes,
)
from torchrl_tit.extras import Missing
from torchrl_tit.modules import acting, make_dt_actor
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.settings.networks import decision_transformer
from torchrl_tit.settings.numbers import (
    Batch,
    Copies,
    Frames,
    Positive,
    Rate,
    Real,
    Steps,
    StepsOrNone,
    Weight,
)
from torchrl_tit.settings.numbers import Episodes as EpisodeCount

from .core.algorithm import Stateful, check_without_waiting, to_networks, total_loss
from .core.task import play_once, seed_copies
from .decision_transformer import ActionSpace, SequenceAlgorithm, SequenceRecipe

try:
    import pytorch_optimizer
except ModuleNotFoundError:
    pytorch_optimizer = Missing("pytorch_optimizer")  # type: ignore[assignment]

_TERMS = ("loss_log_likelihood", "loss_entropy", "entropy", "alpha")
_STEP: list[NestedKey] = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "done")),
]
"""The entries of a step that an episode keeps."""
_LIMIT = 1 - 1e-6
"""The largest action to which a squashed Gaussian assigns a finite likelihood."""


@dataclass(frozen=True, kw_only=True)
class ODT(SequenceRecipe, algorithm="odt"):
    """Online Decision Transformer (arXiv 2202.05607).

    The defaults are those of its authors' release.
    """

    length: ClassVar[str] = "rounds"

    backbone: settings.Network = field(
        default_factory=partial(
            decision_transformer,
            embed_dim=512,
            num_blocks=4,
            num_heads=4,
            timestep_embedding=False,
        )
    )
    """The network; see dt recipes."""
    action_space: ActionSpace = "gaussian"
    """How actions are predicted; always "gaussian" here."""
    acting_num_frames: Frames | None = 5
    """Number of steps that the network reads when it acts, at most the length of a training window;
    null is that length."""
    batch_size: Batch = 256
    """Windows in one gradient step."""
    learning_rate: Rate = 1e-4
    """Learning rate of LAMB after warm-up."""
    weight_decay: Weight = 5e-4
    """Weight decay, on every parameter."""
    alpha_init: Positive = 0.1
    """Initial weight of the entropy (the temperature)."""
    alpha_learning_rate: Rate = 1e-4
    """Learning rate of Adam for the temperature."""
    pretraining_updates: Steps = 5000
    """Gradient steps on the data set."""
    rounds: StepsOrNone = 1500
    """Rounds after pre-training, each with new episodes and gradient steps."""
    episodes_per_round: Copies = 1
    """New episodes at the beginning of a round, played side by side."""
    updates_per_round: Steps = 300
    """Gradient steps in each round."""
    online_return: Real
    """Target return of the episodes that are played for training."""
    exploration_scale: Positive = 1.0
    """Factor on the actions' standard deviation in those episodes; use less than 1 for data of
    noisy policies, because the network learns the noise too."""
    capacity: Batch = 1000
    """Number of episodes in the replay buffer."""
    evaluation_interval: Steps = 10
    """Rounds between evaluations; there is also one before the first round and one after the
    last."""
    evaluation_episodes: EpisodeCount = 10
    """Episodes for each target return, in every evaluation."""

    def build(self) -> ODTAlgorithm:
        """Builds the algorithm."""
        return ODTAlgorithm(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.env:
            raise ValueError("odt plays new episodes, so it needs an environment: name one as env")
        if self.action_space != "gaussian":
            raise ValueError(
                f"action_space is {self.action_space!r}, but exploration needs a distribution of "
                "continuous actions: set it to 'gaussian'"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.pretraining_updates + self.rounds * self.updates_per_round

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether pre-training or an evaluation interval ends at a gradient step."""
        rounds, within = divmod(step - self.pretraining_updates, self.updates_per_round)
        due = rounds % self.evaluation_interval == 0 or rounds == self.rounds
        return rounds >= 0 and within == 0 and due

    def round_begins(self, step: int) -> bool:
        """Returns whether a round begins after ``step`` gradient steps."""
        online = step - self.pretraining_updates
        return online >= 0 and online % self.updates_per_round == 0


class ODTAlgorithm(SequenceAlgorithm[ODT]):
    """Online Decision Transformer: LAMB on the likelihood of actions and their entropy.

    Args:
        recipe: the settings.
    """

    columns = (*_TERMS, "gradient_norm", "online_return", "learning_rate")
    optional_columns = ("online_return",)  # of the newest episodes; pre-training plays none
    action_padding = 0.0

    buffer: OnlineData
    """The data set, and after the first round the newest episodes."""

    def prepare(self, step: int, folder: Path) -> None:
        """Builds data, loss and optimizers."""
        recipe, agent = self.recipe, self.model.train()
        self.step = step
        self.buffer = self.make_buffer()
        self.odt_loss = OnlineDTLoss(
            make_dt_actor(agent.network, agent.head, group=None, every_frame=True),
            alpha_init=recipe.alpha_init,
            target_entropy=-float(self.action_dim),
        )
        self.odt_loss.loss_mask_key = "mask"  # otherwise padding counts
        self.optimizer = make_lamb(
            list(agent.parameters()), recipe.learning_rate, recipe.weight_decay
        )
        self.alpha_optimizer = torch.optim.Adam(
            [self.odt_loss.log_alpha], lr=recipe.alpha_learning_rate
        )

    def make_buffer(self) -> OnlineData:
        """Reads the data set; new episodes are added to it in :meth:`batches`."""
        recipe = self.recipe
        return OnlineData(
            self.load_data(),
            self.measured_items,
            batch_size=recipe.batch_size,
            capacity=recipe.capacity,
            seed=recipe.seed,
        )

    def state(self) -> Mapping[str, Stateful]:
        """Optimizers, temperature, and the episodes to train on."""
        return {
            "optimizer": self.optimizer,
            "alpha": nn.ParameterDict({"value": self.odt_loss.log_alpha}),
            "alpha_optimizer": self.alpha_optimizer,
            "data": self.buffer,
        }

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields windows [B]; plays new episodes when a round begins."""
        while True:
            if self.recipe.round_begins(self.step):
                self.buffer.add(self.explore(self.buffer.rounds))
            yield to_networks(self.buffer.sample(), self.device)

    def loss(self, samples: TensorDictBase) -> TensorDictBase:
        """Returns the terms of the loss; see :meth:`SequenceAlgorithm.loss`."""
        terms = self.odt_loss(samples)
        terms["entropy"] = -terms["loss_entropy"].detach() / terms["alpha"]  # TorchRL's has padding
        return terms

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor | float]:
        """Takes a gradient step on windows [B], of the network and of the temperature."""
        learning_rate = self.recipe.learning_rate_at(step)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        terms = self.loss(batch)
        for optimizer in (self.optimizer, self.alpha_optimizer):
            optimizer.zero_grad()
        total_loss(terms).backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.recipe.max_grad_norm)
        values = torch.stack([*(terms[name].detach() for name in _TERMS), norm])
        check_without_waiting(self.columns[: len(values)], values)
        for optimizer in (self.optimizer, self.alpha_optimizer):
            optimizer.step()
        self.step = step + 1
        others = [self.buffer.newest_return, learning_rate]
        return dict(zip(self.columns, [*values, *others], strict=True))

    def explore(self, number: int) -> Episodes:
        """Plays a round's episodes side by side, with sampled actions, without dropout.

        Args:
            number: number of the round, which determines its seeds together with the recipe's seed.
        """
        recipe = self.recipe
        env = self.make_env(recipe.episodes_per_round, target_return=recipe.online_return)
        seed_copies(env, recipe.seed, number)
        actor = scale_noise(self.policy, recipe.exploration_scale)
        self.model.eval()
        with torch.no_grad(), acting(actor), set_exploration_type(ExplorationType.RANDOM):
            steps, lengths = play_once(env, actor, _STEP)
        self.model.train()
        env.close()
        played = zip(steps, lengths, strict=True)
        return join_episodes([_episode(rollout[:length]) for rollout, length in played])


def make_lamb(parameters: list[nn.Parameter], learning_rate: float, weight_decay: float) -> Any:
    """Builds LAMB (arXiv 1904.00962) as in the release of Online Decision Transformer.

    Weight decay is part of the update whose norm is compared with the norm of the weights. The
    latter is not clipped at 10, which wide layers reach. The step is not divided by a bias
    correction, because the norms would cancel it.
    """
    optimizer = pytorch_optimizer.Lamb(
        parameters,
        lr=learning_rate,
        weight_decay=weight_decay,
        weight_decouple=False,
        eps=1e-8,
        adam_debias=True,
    )
    optimizer.clamp = math.inf
    return optimizer


class OnlineData:
    """Draws batches from a data set; after the first rollout, from a first-in first-out store.

    The store initially holds the best episodes of the data set. Each added episode replaces the
    oldest one; those of the data set are replaced first, from the worst to the best.

    Args:
        episodes: the data set.
        make_storage: cuts windows out of episodes.
        batch_size: windows in a batch.
        capacity: number of episodes in the store.
        seed: seed for sampling.
    """

    def __init__(
        self,
        episodes: Episodes,
        make_storage: Callable[[Episodes], SequenceStorage],
        *,
        batch_size: int,
        capacity: int,
        seed: int,
    ) -> None:
        self.rounds = 0
        """Number of times that episodes were added."""
        self.newest_return = math.nan
        """Mean return of the episodes added last; NaN before the first."""
        self._episodes = episodes
        self._make_storage = make_storage
        self._batch_size = batch_size
        self._capacity = capacity
        self._seed = seed
        self._buffer = self._make_buffer()

    def sample(self) -> TensorDictBase:
        """Draws a batch, with actions clipped to those that a squashed Gaussian can produce."""
        batch = self._buffer.sample()
        batch["action"].clamp_(-_LIMIT, _LIMIT)
        return batch

    def add(self, episodes: Episodes) -> None:
        """Adds episodes to the store."""
        if self.rounds == 0:
            finished = self._episodes.finished.nonzero().squeeze(-1)
            order = self._episodes.returns[finished.cpu()].argsort(stable=True)
            best = finished[order.to(finished.device)][-self._capacity :]
            self._episodes = select_episodes(self._episodes, best)
        device = self._episodes.lengths.device
        joined = join_episodes([self._episodes, episodes.to(device)])
        oldest = max(0, len(joined.lengths) - self._capacity)
        index = joined.lengths.new_tensor(range(oldest, len(joined.lengths)))
        self._episodes = select_episodes(joined, index)
        self.rounds += 1
        self.newest_return = episodes.returns.mean().item()
        self._buffer = self._make_buffer()

    def state_dict(self) -> dict[str, Any]:
        """Returns the episodes of the store, without the data set, and the sampling state."""
        state: dict[str, Any] = {"rounds": self.rounds, "buffer": self._buffer.state_dict()}
        if self.rounds:
            state["newest_return"] = self.newest_return
            state["rows"] = dict(self._episodes.rows.items())
            state["lengths"] = self._episodes.lengths
            state["final_known"] = self._episodes.final_known
            state["cut"] = self._episodes.cut
        return state

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.rounds = state_dict["rounds"]
        if self.rounds:
            self.newest_return = state_dict["newest_return"]
            rows = TensorDict(state_dict["rows"])
            rows.auto_batch_size_(1)
            self._episodes = Episodes(
                rows=rows,
                lengths=state_dict["lengths"],
                final_known=(known := state_dict["final_known"]),
                cut=state_dict.get("cut", torch.zeros_like(known)),  # version 0.1 wrote none
                source=self._episodes.source,
            ).to(self._episodes.lengths.device)
            self._buffer = self._make_buffer()
        self._buffer.load_state_dict(state_dict["buffer"])

    def _make_buffer(self) -> ReplayBuffer:
        seed = np.random.SeedSequence([self._seed, self.rounds]).generate_state(1).item()
        return make_replay_buffer(self._make_storage(self._episodes), self._batch_size, seed=seed)


def scale_noise(actor: TensorDictModuleBase, factor: float) -> TensorDictModuleBase:
    """Returns the same policy with the standard deviation multiplied by a factor.

    Args:
        actor: a policy of :func:`~torchrl_tit.modules.make_dt_actor` with Gaussian actions.
        factor: 1 returns the policy itself.
    """
    if factor == 1:
        return actor
    assert isinstance(actor, ProbabilisticTensorDictSequential)
    *network, draw = actor.module
    scale = TensorModule(lambda std: factor * std, ["scale"], ["scale"])
    return ProbabilisticTensorDictSequential(*network, scale, draw)


def _episode(steps: TensorDictBase) -> Episodes:
    """Builds an episode from its steps [T]."""
    terminated = steps["next", "terminated"].flatten()
    cut_off = ~terminated
    cut_off[:-1] = False
    return episodes_from_arrays(
        steps["observation"],
        steps["action"],
        steps["next", "reward"].flatten(),
        terminated,
        cut_off,
        steps["next", "observation"],
    )
