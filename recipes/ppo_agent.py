"""Backbone, actor and critic of a PPO recipe."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs import EnvBase

from torchrl_tit.modules import Backbone, make_actor, make_value
from torchrl_tit.networks import TwoTrunkNetwork, init_orthogonal_

from .networks import make_network

if TYPE_CHECKING:
    from .ppo import PPO


class Agent(nn.Module):
    """Backbone, actor and critic; the heads read the features that the backbone writes.

    Args:
        recipe: the settings.
        env: an environment with a history, for its shapes and its action space.
    """

    def __init__(self, recipe: PPO, env: EnvBase) -> None:
        super().__init__()
        shape = env.observation_spec["history"].shape[env.batch_dims + 1 :]
        network = make_network(recipe.backbone, shape, recipe.history)
        if recipe.initialization == "orthogonal":
            init_orthogonal_(network)
        separate = isinstance(network, TwoTrunkNetwork)  # trunks for policy and value
        out_keys = ["policy_features", "value_features"] if separate else ["features"]
        self.backbone = Backbone(network, out_keys=out_keys)
        self.actor = make_actor(network.features_dim, env.action_spec_unbatched, in_key=out_keys[0])
        self.critic = make_value(network.features_dim, in_key=out_keys[-1])
        self.to(recipe.torch_device())

    @property
    def policy(self) -> TensorDictModuleBase:
        """History in; features, action, its log-probability and the state's value out."""
        return TensorDictSequential(self.backbone, self.actor, self.critic)
