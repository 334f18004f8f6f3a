"""SAC with any backbone: act, store transitions, and take gradient steps on samples of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
    set_skip_existing,
)
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_tit.checkpoint import load_checkpoint, save_checkpoint
from torchrl_tit.datasets import OnlineHistoryStorage, keep_batch, make_sampler
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate, finished_returns
from torchrl_tit.modules import Backbone, while_acting
from torchrl_tit.networks import build_network
from torchrl_tit.objectives import encode_pairs

from ..algorithm import Algorithm, Stateful, check_finite
from ..critics import make_critic
from ..outcomes import Outcome
from ..stateful import CollectorState
from .settings import SAC

_STORED = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "done")),
]


class SACAlgorithm(Algorithm[SAC]):
    """Soft actor-critic on TorchRL's loss, collector and replay buffer.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    columns = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")
    optional_columns = columns  # nothing is learned during the random steps

    def __init__(self, recipe: SAC) -> None:
        super().__init__(recipe)
        task = self.make_env(1)
        action_spec = task.action_spec_unbatched.to(self.device)
        shape = task.observation_spec["observation"].shape[1:]
        task.close()
        if not isinstance(action_spec, Bounded) or action_spec.ndim != 1:
            raise ValueError(
                f"sac needs continuous actions within bounds, but {recipe.env} has "
                f"{type(action_spec).__name__} actions of shape {list(action_spec.shape)}: use a "
                "ppo recipe"
            )
        backbone = Backbone(build_network(recipe.backbone, shape, trunks="shared"))
        self._policy = _make_actor(backbone, action_spec).to(self.device)
        size = action_spec.shape[0]
        network = recipe.backbone if recipe.critic == "backbone" else None
        # Two critics keep their initial weights; TorchRL would copy a single one and initialise the
        # copy anew.
        critics = [
            make_critic(
                shape, size, recipe.critic_hidden, network, slices=recipe.slice_length > 1
            ).to(self.device)
            for _ in range(2)
        ]
        self.loss = SACLoss(self._policy, critics, loss_function="l2", target_entropy=-float(size))
        self.loss.make_value_estimator(gamma=recipe.gamma)

    @property
    def policy(self) -> TensorDictModuleBase:
        """History in; an action within the task's bounds out."""
        return self._policy

    def networks(self) -> nn.Module:
        """Actor, critics, target critics and temperature."""
        return self.loss

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories; actions are passed on unchanged."""
        recipe = self.recipe
        return make_env(
            recipe.env,
            num_envs,
            seed=seed,
            num_frames=recipe.backbone.num_frames,
            padding=recipe.padding,
            hide_velocities=recipe.hide_velocities,
            clip_actions=False,  # the policy keeps within the bounds
            device=None if self.device.type == "cpu" else self.device,
            **settings,
        )

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, target update, collector and replay buffer."""
        recipe = self.recipe
        self.policy.eval()
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=recipe.learning_rate, fused=True
        )
        self.target = SoftUpdate(self.loss, tau=recipe.tau)
        self.collector = Collector(
            self.make_env(recipe.num_envs, recipe.seed),
            self.policy,
            frames_per_batch=recipe.steps_per_batch,
            total_frames=recipe.final_step,
            init_random_frames=recipe.random_steps,
            device=self.device,
            trust_policy=True,  # ours is on the right device already
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self.collector_state = CollectorState(self.collector, recipe.seed, step)
        storage = OnlineHistoryStorage(
            recipe.final_step,
            recipe.backbone.num_frames,
            num_envs=recipe.num_envs,
            padding=recipe.padding,
            is_init=recipe.slice_length > 1,
            device=self.device,
        )
        self.buffer = ReplayBuffer(
            storage=storage,
            sampler=make_sampler(recipe.slice_length),
            collate_fn=keep_batch,
            batch_size=recipe.batch_size,
        )
        self.buffer_state = StorageState(storage, folder / "replay")

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, collector and environment, and the replay buffer."""
        return {
            "optimizer": self.optimizer,
            "collector": self.collector_state,
            "buffer": self.buffer_state,
        }

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields collected batches, [envs, time]."""
        return while_acting(self.policy, self.collector)

    def size(self, batch: TensorDictBase) -> int:
        """The number of environment steps."""
        return batch.numel()

    def returns(self, batch: TensorDictBase) -> Tensor:
        """Returns of the episodes that ended in a batch."""
        return finished_returns(batch)

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor | float]:
        """Stores a batch, then takes gradient steps on samples of all stored transitions."""
        recipe = self.recipe
        self.buffer.extend(batch.select(*_STORED).transpose(0, 1).reshape(-1))
        self.collector_state.step = step + batch.numel()
        values = torch.full((len(self.columns),), torch.nan)
        if self.collector_state.step > recipe.random_steps:
            self.policy.train()
            for _ in range(max(1, round(batch.numel() * recipe.updates_per_step))):
                values = self._step(self.buffer.sample())
            self.policy.eval()
            check_finite(self.columns, values)
        return dict(zip(self.columns, values, strict=True))

    def play(self, step: int) -> list[Outcome]:
        """Plays full episodes, each with its own seed, with the policy's most likely action."""
        seed, episodes = self.recipe.evaluation_seed, self.recipe.evaluation_episodes
        returns = evaluate(self.make_env, self.policy, episodes, seed=seed)
        return [Outcome(step, returns.tolist())]

    def close(self) -> None:
        """Closes the environments."""
        self.collector.shutdown()

    def _step(self, batch: TensorDictBase) -> Tensor:
        """Takes a gradient step on transitions [B] or slices [N, T]; returns its terms."""
        actor = self.loss.actor_network
        with self.loss.actor_network_params.to_module(actor, preserve_module_state=False):
            pairs = encode_pairs(actor, batch)
        for group, features in zip((batch, batch["next"]), pairs, strict=True):
            group.update(features)
        with set_skip_existing(True):  # of the actor's backbone
            terms = self.loss(batch)
        self.optimizer.zero_grad()
        (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
        self.optimizer.step()
        self.target.step()
        return torch.stack([terms[name].detach() for name in self.columns])


def _make_actor(backbone: Backbone, action_spec: Bounded) -> ProbabilisticActor:
    """A tanh-squashed Gaussian on a backbone's features, with a linear head."""
    head = nn.Sequential(
        nn.Linear(backbone.features_dim, 2 * action_spec.shape[0]), NormalParamExtractor()
    )
    return ProbabilisticActor(
        TensorDictSequential(
            backbone, TensorDictModule(head, backbone.features_keys, ["loc", "scale"])
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
        return_log_prob=True,
    )


class StorageState:
    """The state of a storage that only grows, as parts on the disk.

    Each checkpoint writes what was added since the one before, each frame once, and lists all parts
    that belong to it. A checkpoint that held all steps itself would grow with the run.

    Args:
        storage: the storage.
        folder: folder of the parts, each numbered by the total number of steps at its end.
    """

    def __init__(self, storage: OnlineHistoryStorage, folder: Path) -> None:
        self.storage = storage
        self.folder = folder
        self._parts: list[int] = []
        self._episode_ends = 0  # of all parts

    def state_dict(self) -> dict[str, Any]:
        """Writes the new steps, and returns the numbers of all parts."""
        before, count = max(self._parts, default=0), len(self.storage)
        if count > before:
            part = self.storage.part(before, self._episode_ends)
            save_checkpoint(self.folder, count, part, keep=count)
            self._parts.append(count)
            self._episode_ends = self.storage.num_episode_ends
        return {"parts": list(self._parts)}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Reads a checkpoint's parts. Other parts belong to lost work and will be replaced."""
        self._parts = list(state_dict["parts"])
        for number in self._parts:
            _, part = load_checkpoint(self.folder, number)
            self.storage.add_part(part)
        self._episode_ends = self.storage.num_episode_ends
