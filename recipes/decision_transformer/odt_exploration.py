"""Episodes that Online Decision Transformer plays to train on."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from torchrl.envs import EnvBase

from torchrl_tit.datasets import Episodes, episodes_from_arrays, join_episodes
from torchrl_tit.evaluation import check_rewards
from torchrl_tit.modules.tensor_module import TensorModule

_STEP: list[NestedKey] = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "done")),
]
"""The entries of a step that an episode keeps."""


def scale_noise(actor: TensorDictModuleBase, factor: float) -> TensorDictModuleBase:
    """Returns the same policy with the standard deviation multiplied by a factor.

    Args:
        actor: a policy of :func:`~torchrl_tit.modules.make_dt_actor` with Gaussian actions.
        factor: 1 returns the policy itself.
    """
    if factor == 1:
        return actor
    assert isinstance(actor, ProbabilisticTensorDictSequential)
    *network, draw = actor.module
    scale = TensorModule(lambda std: factor * std, ["scale"], ["scale"])
    return ProbabilisticTensorDictSequential(*network, scale, draw)


def play_episodes(env: EnvBase, policy: TensorDictModuleBase) -> Episodes:
    """Plays one episode in each of several environments, which are stepped side by side.

    Args:
        env: the environments, [N].
        policy: the policy that acts in them.

    Raises:
        FloatingPointError: if a reward of these episodes is NaN or infinite.
    """
    steps: list[TensorDictBase] = []
    tensordict = env.reset()
    playing = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    while playing.any():
        step, tensordict = env.step_and_maybe_reset(policy(tensordict))
        check_rewards(step["next", "reward"].squeeze(-1).masked_fill(~playing, 0))
        steps.append(step.select(*_STEP).cpu())
        playing &= ~step["next", "done"].squeeze(-1)
    return join_episodes([_first_episode(rollout) for rollout in torch.stack(steps, dim=1)])


def _first_episode(steps: TensorDictBase) -> Episodes:
    """Builds an episode from the steps [T] of an environment, up to the first end."""
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
