"""Value networks of actor-critic algorithms: on observations or on a backbone."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.modules import MLP

from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.frames.observation import Observations, read_observations
from torchrl_tit.modules.tensor_module import TensorModule, TensorValue
from torchrl_tit.settings import Flat, Network

from .policies import make_backbone


def make_critic(
    observation: Observations,
    action_dim: int,
    hidden: Sequence[int],
    network: Network | None = None,
    *,
    values: int = 1,
    out_key: str = "state_action_value",
    slices: bool = False,
    eps: float | None = None,
) -> TensorDictModuleBase:
    """Builds an MLP on the newest observation or a backbone's features, and on the action, if any.

    Args:
        observation: spec of the observation, or of each by name.
        action_dim: number A of entries of an action; 0 if it is not read.
        hidden: widths of the MLP's hidden layers.
        network: settings of the backbone; if None, the MLP reads the newest observation.
        values: number of values, such as one for each discrete action.
        out_key: key of the values.
        slices: whether the backbone reads slices of consecutive steps [..., T] in TorchRL's
            recurrent mode; it then also reads "observation" and "is_init".
        eps: as in :func:`~recipes.policies.make_backbone`; normalises what an MLP reads, too.

    Returns:
        A module that reads "observation" [..., D], or "history" [..., K, *obs], and "action"
        [..., A], and writes ``out_key``, float [..., values].

    Raises:
        ValueError: if there is no backbone, and the observation is not a single array.
    """
    modules: list[TensorDictModuleBase] = []
    if network is not None:
        key = "critic_features"
        backbone = make_backbone(network, observation, out_key=key, slices=slices, eps=eps)
        modules, size = [backbone], backbone.features_dim
    else:
        key, size = "observation", _array_size(observation)
        if eps is not None:
            frames = NormalizedFrames(Flat().build((size,)), math.inf, eps=eps)
            flat = nn.Sequential(frames, nn.Flatten(-2))
            modules, key = [TensorModule(flat, [key], ["normalized"])], "normalized"
    mlp = MLP(
        size + action_dim,
        values,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},
    )
    in_keys = [key, "action"] if action_dim else [key]
    return TensorDictSequential(*modules, TensorValue(mlp, in_keys=in_keys, out_keys=[out_key]))


def _array_size(observation: Observations) -> int:
    """Returns the number of entries of the only observation, which must be an array."""
    read = read_observations(observation)
    first = next(iter(read.values()))
    if len(read) > 1:
        raise ValueError(
            f"an MLP cannot value several observations ({', '.join(read)}): set critic to "
            "'backbone'"
        )
    if first.kind != "array":
        kind = "images" if first.kind == "image" else first.kind
        raise ValueError(f"an MLP cannot value {kind} {first.shape}: set critic to 'backbone'")
    return first.entries
