"""Episodes that Online Decision Transformer plays to train on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_tit.datasets import Episodes, episodes_from_arrays, join_episodes
from torchrl_tit.modules import acting

from .agent import DTAgent

if TYPE_CHECKING:
    from .odt import ODT

_STEP: list[NestedKey] = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "done")),
]
"""What an episode keeps of a step."""


def explore(agent: DTAgent, recipe: ODT, number: int) -> Episodes:
    """Plays a round's episodes side by side, with actions that are drawn.

    Args:
        agent: the network, which is put into evaluation mode for it.
        recipe: the settings.
        number: of the round, which its seeds follow from together with the recipe's.
    """
    seed = int(np.random.SeedSequence([recipe.seed, number]).generate_state(1)[0]) % 2**31
    env = agent.make_env(recipe.episodes_per_round, recipe.online_return, seed)
    actor = scale_noise(agent.actor, recipe.exploration_scale)
    agent.eval()
    with torch.no_grad(), acting(actor), set_exploration_type(ExplorationType.RANDOM):
        episodes = play_episodes(env, actor)
    agent.train()
    env.close()
    return episodes


def scale_noise(actor: TensorDictModuleBase, factor: float) -> TensorDictModuleBase:
    """The same policy, whose standard deviation is multiplied by a factor.

    Args:
        actor: a policy of :func:`~torchrl_tit.modules.make_dt_actor` with Gaussian actions.
        factor: 1 leaves it as it is.
    """
    if factor == 1:
        return actor
    assert isinstance(actor, ProbabilisticTensorDictSequential)
    *network, draw = actor.module
    scale = TensorDictModule(lambda std: factor * std, ["scale"], ["scale"])
    return ProbabilisticTensorDictSequential(*network, scale, draw)


def play_episodes(env: EnvBase, policy: TensorDictModuleBase) -> Episodes:
    """Plays one episode in each of the environments that are stepped side by side.

    Args:
        env: the environments, [N].
        policy: acts in them.
    """
    steps: list[TensorDictBase] = []
    tensordict = env.reset()
    playing = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    while playing.any():
        step, tensordict = env.step_and_maybe_reset(policy(tensordict))
        steps.append(step.select(*_STEP).cpu())
        playing &= ~step["next", "done"].squeeze(-1)
    return join_episodes([_first_episode(rollout) for rollout in torch.stack(steps, dim=1)])


def _first_episode(steps: TensorDictBase) -> Episodes:
    """Makes an episode of the steps [T] of an environment, up to its first end."""
    ends = steps["next", "done"].flatten().nonzero()
    steps = steps[: int(ends[0]) + 1]
    terminated = steps["next", "terminated"].flatten()
    cut_off = ~terminated
    cut_off[:-1] = False
    return episodes_from_arrays(
        steps["observation"],
        steps["action"],
        steps["next", "reward"].flatten(),
        terminated,
        cut_off,
        steps["next", "observation"],
    )
