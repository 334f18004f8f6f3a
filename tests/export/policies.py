"""Small policies and their tasks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs import EnvBase

from torchrl_tit.envs import make_env, observation_specs
from torchrl_tit.export.comparison import COPIES
from torchrl_tit.export.parts import read_parts
from torchrl_tit.export.program import Program, make_program
from torchrl_tit.modules import Backbone, history_keys, make_actor, make_value
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings import FrameSettings, HistorySettings, Linear, Outer

MakeEnv = Callable[..., EnvBase]


def make_policy(
    env: str = "CartPole-v1",
    frame: FrameSettings | None = None,
    history: HistorySettings | None = None,
    *,
    num_frames: int = 3,
    **settings: Any,
) -> tuple[TensorDictModuleBase, MakeEnv]:
    """A policy with a critic, whose weights are far from those that it would start with."""
    if history is None:
        history = Outer(num_blocks=1, num_heads=1)

    def task(copies: int) -> EnvBase:
        made = make_env(env, copies, num_frames=num_frames, **settings)
        return made.append_transform(backbone.make_transforms())

    made = make_env(env, num_frames=num_frames, **settings)
    observation, action = observation_specs(made), made.action_spec_unbatched
    made.close()
    network = HistoryNetwork(
        frame or Linear(embed_dim=4), history, observation_shape=observation, num_frames=num_frames
    )
    backbone = Backbone(network, history_keys(observation))
    mask = "action_mask" if settings.get("mask_actions") else None
    actor = make_actor(network.features_dim, action, mask_key=mask, batch_dims=0)
    policy = TensorDictSequential(backbone, actor, make_value(network.features_dim)).eval()
    shake(policy)
    return policy, task


@torch.no_grad()
def shake(policy: nn.Module) -> None:
    """Moves all weights, so that a policy's decisions depend on what it reads.

    Less where many are added up: otherwise a wide network turns rounding into large differences.
    """
    for parameter in policy.parameters():
        entries = parameter.shape[-1] if parameter.ndim else 1
        parameter.add_(torch.randn_like(parameter) / max(3.0, entries**0.5))


def program_of(policy: TensorDictModuleBase, task: MakeEnv, **form: bool) -> Program:
    env = task(COPIES)
    program = make_program(read_parts(policy, env), **form)
    env.close()
    return program
