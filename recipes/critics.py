"""Critics of actor-critic algorithms with replay: Q(s, a) on observations or on a backbone."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.modules import MLP, ValueOperator

from torchrl_tit.modules import Backbone
from torchrl_tit.networks import build_network
from torchrl_tit.settings import Network


def make_critic(
    observation_shape: torch.Size,
    action_dim: int,
    hidden: Sequence[int],
    network: Network | None = None,
    *,
    slices: bool = False,
) -> TensorDictModuleBase:
    """Builds Q(s, a): an MLP on the newest observation or a backbone's features, and the action.

    Args:
        observation_shape: shape of an observation.
        action_dim: number A of entries of an action.
        hidden: widths of the MLP's hidden layers.
        network: settings of the backbone; if None, the MLP reads the newest observation.
        slices: whether the backbone is to read slices of consecutive steps [..., T], if it is
            within TorchRL's recurrent mode; it then reads "observation" and "is_init" too.

    Returns:
        A module that reads "observation" [..., *obs], or "history" [..., K, *obs], and "action"
        [..., A], and writes "state_action_value", float [..., 1].

    Raises:
        ValueError: if there is no backbone to read observations of more than one dimension.
    """
    modules: list[TensorDictModuleBase] = []
    key, size = "observation", observation_shape.numel()
    if network is not None:
        key = "critic_features"
        backbone = Backbone(
            build_network(network, observation_shape, trunks="shared"),
            out_keys=[key],
            observation_keys=["observation"] if slices else None,
        )
        modules, size = [backbone], backbone.features_dim
    elif len(observation_shape) != 1:
        raise ValueError(
            f"an MLP cannot value images {tuple(observation_shape)}: set critic to 'backbone'"
        )
    mlp = MLP(
        size + action_dim,
        1,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},
    )
    return TensorDictSequential(*modules, ValueOperator(mlp, in_keys=[key, "action"]))
