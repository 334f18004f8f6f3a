"""Backbone, actor and critic of a PPO recipe."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode

from torchrl_tit.modules import Backbone, LSTMBackbone, LSTMConfig, make_actor, make_value
from torchrl_tit.networks import CoBERL, TwoTrunkNetwork, init_orthogonal_
from torchrl_tit.objectives import contrastive_prediction_loss

from ..compilation import autocast_type
from ..networks import make_network

if TYPE_CHECKING:
    from .recipe import PPO


class Agent(nn.Module):
    """Backbone, actor and critic; the heads read the features that the backbone writes.

    Args:
        recipe: the settings.
        env: an environment with a history, for its shapes and its action space.
    """

    def __init__(self, recipe: PPO, env: EnvBase) -> None:
        super().__init__()
        shape = env.observation_spec["history"].shape[env.batch_dims + 1 :]
        self.backbone: Backbone | LSTMBackbone
        if isinstance(recipe.backbone, LSTMConfig):
            self.backbone = LSTMBackbone(shape, recipe.history, recipe.backbone)
            keys, features_dim = ["features"], self.backbone.features_dim
        else:
            network = make_network(recipe.backbone, shape, recipe.history)
            separate = isinstance(network, TwoTrunkNetwork)  # trunks for policy and value
            keys = ["policy_features", "value_features"] if separate else ["features"]
            autocast = autocast_type(recipe.precision, recipe.torch_device())
            self.backbone = Backbone(network, out_keys=keys, autocast=autocast)
            features_dim = network.features_dim
        if recipe.initialization == "orthogonal":
            init_orthogonal_(self.backbone)
        self.actor = make_actor(features_dim, env.action_spec_unbatched, in_key=keys[0])
        self.critic = make_value(features_dim, in_key=keys[-1])
        self.to(recipe.torch_device())

    def encode(self, samples: TensorDictBase) -> TensorDictBase:
        """Writes the features of a minibatch: steps, or sequences where the network is recurrent.

        Args:
            samples: steps [N], or sequences [N, time].
        """
        if isinstance(self.backbone, LSTMBackbone):
            with set_recurrent_mode(True):
                return self.backbone(samples)
        return self.backbone(samples)

    def contrastive_loss(self, history: Tensor, masked_fraction: float) -> Tensor:
        """CoBERL's contrastive loss, in a pass of its own: its transformer looks both ways.

        Args:
            history: [N, K, *observation].
            masked_fraction: share of the steps that are hidden.

        Returns:
            float [].
        """
        network = self.backbone.module
        assert isinstance(network, CoBERL)
        mask = torch.rand(history.shape[:2], device=history.device) < masked_fraction
        return contrastive_prediction_loss(*network.predict_masked(history, mask), mask)

    @property
    def policy(self) -> TensorDictModuleBase:
        """History in; features, action, its log-probability and the state's value out."""
        return TensorDictSequential(self.backbone, self.actor, self.critic)
