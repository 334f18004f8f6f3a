"""PPO's collectors: the environments, in this process or in several, and the policy in each."""

from __future__ import annotations

import signal
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from torchrl_tit.envs import make_env
from torchrl_tit.modules import Backbone

from ..algorithm import torch_device
from ..compilation import STATIC_SHAPES
from .rollout import FrameCollector
from .settings import PPO


def make_collector(
    recipe: PPO, policy: TensorDictModuleBase, backbone: Backbone, step: int, *, compiled: bool
) -> BaseCollector:
    """Builds the collector of batches [num_envs, time], in this process or in several.

    Several share the environments, each with a copy of the policy. If they are asynchronous, a
    batch comes from one of them.

    Args:
        recipe: the settings.
        policy: history in, action out.
        backbone: the policy's backbone.
        step: number of steps already done.
        compiled: whether to compile the policy where that pays off.
    """
    settings: dict[str, Any] = {
        "frames_per_batch": recipe.steps_per_batch,
        "device": torch_device(recipe.device),
        "trust_policy": True,  # ours is on the right device already
        "auto_register_policy_transforms": False,
        "use_buffers": False,  # they would have the histories, which steps lack
    }
    if recipe.collectors == 1:
        # Which tokens are reused is decided between two parts that are compiled separately.
        whole = compiled and not backbone.keeps_frames
        return FrameCollector(
            _make_envs(recipe, backbone, recipe.num_envs, recipe.seed),
            policy,
            total_frames=recipe.final_step,
            compile_policy=STATIC_SHAPES if whole else None,
            track_traj_ids=False,
            return_same_td=True,  # without buffers, each batch has its own memory
            **settings,
        )
    kind = MultiAsyncCollector if recipe.async_collection else MultiSyncCollector
    make_share = partial(_make_share, recipe, backbone, step)
    return kind(
        [partial(make_share, index) for index in range(recipe.collectors)],
        policy,
        total_frames=recipe.final_step - step,
        collector_class=FrameCollector,
        **settings,
    )


def make_task(recipe: PPO, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
    """Builds a recipe's task, with histories.

    Args:
        recipe: the settings.
        num_envs: environments that are stepped side by side.
        seed: of the first environment.
        **settings: of the task.
    """
    device = torch_device(recipe.device)
    return make_env(
        recipe.env,
        num_envs,
        seed=seed,
        num_frames=recipe.backbone.num_frames,
        padding=recipe.padding,
        hide_velocities=recipe.hide_velocities,
        device=None if device.type == "cpu" else device,
        **settings,
    )


def with_state(env: EnvBase, backbone: Backbone) -> EnvBase:
    """Adds the transforms that carry the state of a recurrent network from step to step."""
    return env.append_transform(backbone.make_transforms()) if backbone.is_recurrent else env


def _make_share(recipe: PPO, backbone: Backbone, step: int, index: int) -> EnvBase:
    """Builds the environments of one process; called in that process.

    Random numbers follow from the run's seed and the step at which the process starts.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process
    torch.set_num_threads(recipe.threads)
    share = recipe.num_envs // recipe.collectors
    seeds = np.random.SeedSequence([recipe.seed, index, step])
    torch.manual_seed(seeds.generate_state(1).item())
    # At the start, the environments have the same seeds as in one process.
    seed = recipe.seed + index * share if step == 0 else seeds.generate_state(2)[1].item() >> 1
    return _make_envs(recipe, backbone, share, seed)


def _make_envs(recipe: PPO, backbone: Backbone, num_envs: int, seed: int) -> EnvBase:
    """Builds environments whose steps keep each observation once."""
    mode = recipe.vectorization_mode
    task = make_task(recipe, num_envs, seed, vectorization_mode=mode, keep_histories=False)
    return with_state(task, backbone)
