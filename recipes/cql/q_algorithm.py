"""Shared by conservative Q-learning with continuous and with discrete actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer, TensorSpec
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_tit.datasets import HistoryStorage, load_episodes, make_replay_buffer
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import Backbone
from torchrl_tit.networks import build_network

from ..algorithm import check_finite
from ..compilation import should_compile
from ..dataset_algorithm import DatasetAlgorithm
from ..outcomes import Outcome
from .settings import QRecipe

RecipeT = TypeVar("RecipeT", bound=QRecipe)


class QAlgorithm(DatasetAlgorithm[RecipeT]):
    """An algorithm whose loss holds the weights of all networks, the policy's among them.

    Args:
        recipe: the settings.
    """

    continuous: ClassVar[bool]
    """Whether actions are continuous."""
    compiles_on: ClassVar[tuple[str, ...]]
    """Types of device on which compiling pays off."""

    loss: LossModule
    """The losses, with all weights."""
    _policy: TensorDictModuleBase

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        task = self.make_env(1)
        self.action_spec = task.action_spec_unbatched.to(self.device)
        self.observation_shape = task.observation_spec["observation"].shape[task.batch_dims :]
        task.close()

    @property
    def policy(self) -> TensorDictModuleBase:
        """History in, action out; its weights are among those of the loss."""
        return self._policy

    def networks(self) -> nn.Module:
        """All networks and their targets."""
        return self.loss

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories."""
        return make_env(
            self.recipe.env,
            num_envs,
            seed=seed,
            num_frames=self.recipe.backbone.num_frames,
            padding=self.recipe.padding,
            clip_actions=False,  # the policy keeps within the bounds, which the losses need
            device=None if self.device.type == "cpu" else self.device,
            **settings,
        )

    def make_backbone(self) -> Backbone:
        """Builds the policy's backbone."""
        return Backbone(
            build_network(self.recipe.backbone, self.observation_shape, trunks="shared"),
            observation_keys=["observation"] if self.recipe.slice_length > 1 else None,
        )

    def make_buffer(self) -> ReplayBuffer:
        """Reads the data set into a replay buffer of transitions with histories."""
        recipe = self.recipe
        episodes = load_episodes(recipe.dataset, **recipe.reading())
        if episodes.rows["action"].is_floating_point() != self.continuous:
            found, expected = ("integers", "floats") if self.continuous else ("floats", "integers")
            raise ValueError(
                f"the actions in {recipe.dataset} are {found}, but those of {recipe.env} are "
                f"{expected}: use other data"
            )
        storage = HistoryStorage(
            episodes.to(self.device),
            recipe.backbone.num_frames,
            padding=recipe.padding,
            time_limits=recipe.time_limits,
            terminal_observations=recipe.terminal_observations,
            unfinished=recipe.unfinished,
            is_init=recipe.slice_length > 1,
        )
        return make_replay_buffer(
            storage, recipe.batch_size, seed=recipe.seed, slice_length=recipe.slice_length
        )

    def should_compile(self) -> bool:
        """Whether losses run through ``torch.compile``."""
        setting = self.recipe.compile
        if self.recipe.slice_length > 1:  # their number of frames varies
            return False
        pays = setting == "on" or self.device.type in self.compiles_on
        return pays and should_compile(setting, self.recipe.total_updates)

    def named(self, terms: Tensor) -> Mapping[str, Tensor]:
        """Checks and names the terms of an update, float [columns].

        Checking on a GPU would mean waiting for it, so there the runner checks, less often.
        """
        if terms.device.type == "cpu":
            check_finite(self.columns, terms)
        return dict(zip(self.columns, terms, strict=True))

    def play(self, step: int) -> list[Outcome]:
        """Plays full episodes side by side, each with its own seed, without dropout."""
        seed, episodes = self.recipe.evaluation_seed, self.recipe.evaluation_episodes
        returns = evaluate(self.make_env, self.policy, episodes, seed=seed, shrink=True)
        return [Outcome(step, returns.tolist())]

    def check(self) -> None:
        """As :meth:`DatasetAlgorithm.check`; also checks that compiling works if requested."""
        self.should_compile()
        super().check()


def describe(spec: TensorSpec) -> str:
    """Describes actions, for messages."""
    kind = "continuous" if spec.dtype.is_floating_point else "discrete"
    return f"{kind} ({type(spec).__name__}, shape {list(spec.shape)})"


def parameters_of(params: Any) -> list[nn.Parameter]:
    """Lists the parameters of one of a loss's networks, for an optimizer."""
    return [p for p in params.values(True, True) if isinstance(p, nn.Parameter)]
