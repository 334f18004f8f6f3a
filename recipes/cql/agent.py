"""Networks and losses of the recipes of conservative Q-learning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import MLP, QValueModule, ValueOperator
from torchrl.objectives.common import LossModule

from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import Backbone, make_squashed_actor
from torchrl_tit.networks import TwoTrunkNetwork
from torchrl_tit.objectives import ContinuousCQLLoss, DelayedDiscreteCQLLoss

from ..networks import make_network

if TYPE_CHECKING:
    from .continuous import CQL
    from .discrete import DiscreteCQL
    from .recipe import CQLRecipe


class QAgent:
    """A loss with the weights of all networks, and the policy, whose weights are among them.

    Args:
        recipe: the settings.
    """

    policy: TensorDictModuleBase
    loss: LossModule

    def __init__(self, recipe: CQLRecipe[Any]) -> None:
        self.recipe = recipe
        self.device = recipe.torch_device()
        task = self.make_env(1)
        self.action_spec = task.action_spec_unbatched.cpu()
        self.shape = task.observation_spec["history"].shape[2:]
        task.close()

    def make_env(self, num_envs: int, **settings: Any) -> EnvBase:
        """Builds the task, with the history as part of it; settings go to the task."""
        return make_env(
            self.recipe.env,
            num_envs,
            history=self.recipe.history,
            padding=self.recipe.padding,
            clip_actions=False,  # the policy keeps within the bounds, which the losses need
            device=None if self.device.type == "cpu" else self.device,
            **settings,
        )

    def make_backbone(self, features_key: str) -> tuple[Backbone, int]:
        """Builds a backbone of the recipe's settings; returns it and the size of its features."""
        recipe = self.recipe
        network = make_network(recipe.backbone, self.shape, recipe.history)
        one = network.only_policy() if isinstance(network, TwoTrunkNetwork) else network
        return Backbone(one, out_keys=[features_key]), network.features_dim

    def play(self, episodes: int, seed: int) -> Tensor:
        """Plays episodes side by side and returns what each returned; float64 [episodes]."""
        return evaluate(self.make_env, self.policy, episodes, seed=seed, shrink=True)

    def networks(self) -> list[nn.Module]:
        """Everything that may hold dropout; the loss does not list its networks as modules."""
        return [self.policy]

    def train(self) -> None:
        """Switches dropout on."""
        for network in self.networks():
            network.train()

    def eval(self) -> None:
        """Switches dropout off."""
        for network in self.networks():
            network.eval()

    def state_dict(self) -> dict[str, Any]:
        """Returns the weights of all networks, and the temperature."""
        return self.loss.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes weights over."""
        self.loss.load_state_dict(state_dict)


class CQLAgent(QAgent):
    """Actor on a backbone, and critics, for continuous actions.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    loss: ContinuousCQLLoss

    def __init__(self, recipe: CQL) -> None:
        super().__init__(recipe)
        if not isinstance(self.action_spec, Bounded) or self.action_spec.ndim != 1:
            raise ValueError(
                f"cql needs continuous actions within bounds, but those of {recipe.env} are "
                f"{_describe(self.action_spec)}: use a discrete-cql recipe where they are discrete"
            )
        backbone, features_dim = self.make_backbone("features")
        # The bounds too are where the networks are: a CUDA graph reads nothing of the CPU.
        head = make_squashed_actor(features_dim, self.action_spec.to(self.device))
        self.policy = ProbabilisticTensorDictSequential(backbone, *head).to(self.device)
        critics = [self._make_critic(recipe.critic, recipe.critic_hidden) for _ in range(2)]
        self.loss = ContinuousCQLLoss(
            self.policy,
            [critic.to(self.device) for critic in critics],
            action_spec=self.action_spec.to(self.device),
            min_q_weight=recipe.conservative_weight,
            num_random=recipe.action_samples,
            over_critics=recipe.over_critics,
            alpha_init=recipe.temperature_init,
            # On a CPU two products are faster than a stacked one.
            deactivate_vmap=self.device.type == "cpu",
        )
        self.loss.make_value_estimator(gamma=recipe.gamma)

    def networks(self) -> list[nn.Module]:
        """Actor and critics."""
        return [self.policy, self.loss.qvalue_network]

    def _make_critic(self, kind: str, hidden: Sequence[int]) -> TensorDictModuleBase:
        """Q(s, a): an MLP on observation and action, or on a backbone's features and action."""
        first: list[TensorDictModuleBase] = []
        key, size = "observation", self.shape.numel()
        if kind == "backbone":
            key = "critic_features"
            backbone, size = self.make_backbone(key)
            first.append(backbone)
        elif len(self.shape) != 1:
            raise ValueError(
                f"an MLP cannot value images {tuple(self.shape)}: set critic to 'backbone'"
            )
        mlp = MLP(
            size + self.action_spec.shape[0],
            1,
            num_cells=list(hidden),
            activation_class=nn.ReLU,
            activation_kwargs={"inplace": True},
        )
        value = ValueOperator(mlp, in_keys=[key, "action"], out_keys=["state_action_value"])
        return TensorDictSequential(*first, value)


class DiscreteCQLAgent(QAgent):
    """A value for each action, on a backbone.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not discrete.
    """

    loss: DelayedDiscreteCQLLoss

    def __init__(self, recipe: DiscreteCQL) -> None:
        super().__init__(recipe)
        if not isinstance(self.action_spec, Categorical):
            raise ValueError(
                f"discrete-cql needs a few discrete actions, but those of {recipe.env} are "
                f"{_describe(self.action_spec)}: use a cql recipe where they are continuous"
            )
        backbone, features_dim = self.make_backbone("features")
        actions = self.action_spec.space.n
        head = TensorDictModule(nn.Linear(features_dim, actions), ["features"], ["action_value"])
        self.policy = TensorDictSequential(backbone, head, QValueModule(spec=self.action_spec)).to(
            self.device
        )
        self.loss = DelayedDiscreteCQLLoss(self.policy, action_space="categorical")
        self.loss.make_value_estimator(gamma=recipe.gamma)


def _describe(spec: TensorSpec) -> str:
    kind = "continuous" if spec.dtype.is_floating_point else "discrete"
    return f"{kind} ({type(spec).__name__}, shape {list(spec.shape)})"


def parameters_of(params: Any) -> list[nn.Parameter]:
    """Lists the parameters of one of a loss's networks, for an optimizer."""
    return [p for p in params.values(True, True) if isinstance(p, nn.Parameter)]
