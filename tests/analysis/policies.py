"""Small policies on images and arrays, untrained."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Categorical, Unbounded

from torchrl_tit.layers import init_orthogonal_
from torchrl_tit.modules import Backbone, history_keys, make_actor, make_value
from torchrl_tit.networks import build_network
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import (
    catformer,
    coberl,
    enhanced_tit,
    nature_cnn,
    resnet,
    vanilla_tit,
)

TIT: dict[str, Any] = {
    "patch_size": 12,
    "embed_dim": 8,
    "num_heads_inner": 2,
    "num_heads_outer": 2,
    "ffn_dropout_inner": 0.5,  # explanations switch it off
    "features_dim": 8,
}
IMAGE_NETWORKS: dict[str, Network] = {
    "enhanced": enhanced_tit(3, **TIT),
    "vanilla": vanilla_tit(3, **TIT),
    "one block": enhanced_tit(3, num_blocks=1, **TIT),
    "shared blocks": vanilla_tit(3, share_blocks=True, **TIT),
    "without outer": enhanced_tit(3, outer=False, **TIT),
    "nature-cnn": nature_cnn(3, features_dim=8),
    "resnet": resnet(3, features_dim=8),
    "catformer": catformer(3, embed_dim=10, features_dim=8),
    "coberl": coberl(3, embed_dim=8, features_dim=8),
}
IMAGE = (36, 48)
ACTIONS = 5


def make_policy(
    network: Network, observation: Any, *, continuous: bool = False
) -> TensorDictSequential:
    """Backbone, actor and critic, with heads that tell states apart."""
    separate = network.trunks == "separate"
    keys = ["policy_features", "value_features"] if separate else ["features"]
    histories = history_keys(observation)
    backbone = Backbone(build_network(network, observation), histories, keys)
    init_orthogonal_(backbone)  # large enough that different states look different
    spec = Unbounded((2,)) if continuous else Categorical(ACTIONS)
    actor = make_actor(backbone.features_dim, spec, in_key=keys[0])
    init_orthogonal_(actor)
    return TensorDictSequential(backbone, actor, make_value(backbone.features_dim, in_key=keys[-1]))


def make_images(count: int, frames: int = 3) -> TensorDict:
    """Bytes [count, frames, 36, 48], and an action of each state."""
    histories = torch.randint(256, (count, frames, *IMAGE), dtype=torch.uint8)
    actions = torch.arange(count) % ACTIONS
    return TensorDict({"history": histories, "action": actions}, [count])


class Mean(nn.Module):
    """A deterministic policy's head."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, 2)

    def forward(self, features: Tensor) -> Tensor:
        return self.linear(features).tanh()


def make_deterministic_policy(network: Network, observation: Any) -> TensorDictSequential:
    backbone = Backbone(build_network(network, observation, trunks="shared"))
    head = TensorDictModule(Mean(backbone.features_dim), ["features"], ["action"])
    return TensorDictSequential(backbone, head)
