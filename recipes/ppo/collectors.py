"""PPO's collectors: the environments, in this process or in several, and the policy in each."""

from __future__ import annotations

import copy
import signal
from dataclasses import replace
from functools import partial
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from torchrl_tit.modules import Backbone

from ..algorithm import torch_device
from ..compilation import STATIC_SHAPES
from ..ray_collector import ClusterCollector
from ..shares import make_share
from ..task import make_task, seed_copies
from .rollout import FrameCollector
from .settings import PPO


def make_collector(
    recipe: PPO, policy: TensorDictModuleBase, backbone: Backbone, step: int, *, compiled: bool
) -> BaseCollector:
    """Builds the collector of batches [num_envs, time]: in this process, in several, or on Ray.

    Several processes share the environments, each with a copy of the policy. Environments begin new
    episodes, also if the run is resumed.

    Args:
        recipe: the settings.
        policy: the policy, from histories to actions.
        backbone: the policy's backbone.
        step: number of steps already done.
        compiled: whether to compile the policy where that pays off.
    """
    device = torch_device(recipe.device)
    own: dict[str, Any] = {
        "trust_policy": True,  # ours is on the right device already
        "auto_register_policy_transforms": False,
        "use_buffers": False,  # they would hold the histories, which steps lack
    }
    settings = {"frames_per_batch": recipe.steps_per_batch, "device": device, **own}
    share = recipe.num_envs // recipe.collectors
    if recipe.ray is not None:
        there = replace(recipe, device="cpu")
        make_envs = partial(_make_envs, there, copy.deepcopy(backbone).to("cpu"))
        return ClusterCollector(
            [
                partial(make_share, make_envs, there, share, step, index)
                for index in range(recipe.collectors)
            ],
            policy,
            address=recipe.ray,
            threads=recipe.threads,
            device=device,
            frames_per_batch=recipe.steps_per_batch,
            total_frames=recipe.final_step - step,
            collector_class=FrameCollector,
            settings=own,
        )
    if recipe.collectors == 1:
        # The tokens to reuse are chosen between two parts that are compiled separately.
        whole = compiled and not backbone.keeps_frames
        return FrameCollector(
            seed_copies(_make_envs(recipe, backbone, recipe.num_envs), recipe.seed, step),
            policy,
            total_frames=recipe.final_step - step,
            compile_policy=STATIC_SHAPES if whole else None,
            track_traj_ids=False,
            return_same_td=True,  # without buffers, each batch has its own memory
            **settings,
        )
    make_envs = partial(_make_envs, recipe, backbone)
    return MultiSyncCollector(
        [
            partial(_make_share, make_envs, recipe, share, step, index)
            for index in range(recipe.collectors)
        ],
        policy,
        total_frames=recipe.final_step - step,
        collector_class=FrameCollector,
        **settings,
    )


def with_state(env: EnvBase, backbone: Backbone) -> EnvBase:
    """Adds the transforms that carry the state of a recurrent network from step to step."""
    return env.append_transform(backbone.make_transforms()) if backbone.is_recurrent else env


def _make_share(*args: Any) -> EnvBase:
    """Builds the environments of one process, as :func:`make_share` does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process
    return make_share(*args)


def _make_envs(recipe: PPO, backbone: Backbone, num_envs: int) -> EnvBase:
    """Builds environments whose steps keep each observation once."""
    mode = recipe.vectorization_mode
    task = make_task(recipe, num_envs, vectorization_mode=mode, keep_histories=False)
    return with_state(task, backbone)
