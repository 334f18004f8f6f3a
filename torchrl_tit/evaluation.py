"""Returns of a policy over whole episodes, as measured in the paper."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_tit.layers.standardize import widest_float
from torchrl_tit.modules import acting
from torchrl_tit.networks.building import evaluating

Policy = Callable[[TensorDictBase], TensorDictBase]

_WATCHER: ContextVar[Callable[[int], Any] | None] = ContextVar("watcher", default=None)


def evaluate(
    env: EnvBase | Callable[[int], EnvBase],
    policy: Policy,
    episodes: int = 100,
    *,
    seed: int = 0,
    shrink: bool = False,
    deterministic: bool = True,
) -> Tensor:
    """Plays whole episodes with a policy, without training it.

    Episode i is seeded with ``seed + i``, so the returns do not depend on the number of
    environments. Episodes run side by side, one in each environment, until the last one ends: long
    episodes count as much as short ones. For Atari (:class:`~torchrl_tit.envs.AtariEnv`) an episode
    is a whole game with all of its points and lives. Evaluation does not affect training: it
    restores the policy's training mode and the states of the global random generators of PyTorch,
    NumPy and Python.

    Args:
        env: an environment of any batch size whose `reset` takes a seed, as those of
            :func:`~torchrl_tit.envs.make_env` and TorchRL's `GymWrapper` do, also within its
            `SerialEnv` and `ParallelEnv`, and whose rewards are the task's own, not clipped. It is
            reset, which ends its current episodes. Or a function that makes an environment with a
            given number of copies; it is called with ``episodes``, and the environment is closed at
            the end.
        policy: writes the action into the tensordict. It acts in evaluation mode.
        episodes: number of episodes.
        seed: seed of the first episode.
        shrink: whether the policy is called only for environments whose first episode is still
            running, which saves time if episodes differ in length. The policy must accept batches
            of any size and keep no state from step to step.
        deterministic: whether to take the distribution's deterministic action (its mode or mean)
            instead of a sample.

    Returns:
        The undiscounted return of each episode; float64 [episodes], on the environment's device.

    Raises:
        ValueError: if ``episodes`` is less than 1.
        FloatingPointError: if a reward in one of these episodes is NaN or infinite.

    Source: "Transformer in Transformer as Backbone for Deep Reinforcement Learning" (arXiv
    2212.14538), section 4: the final model over 100 episodes.

    Example:
        >>> from torchrl.data import Categorical
        >>> from torchrl.modules import RandomPolicy
        >>> from torchrl_tit.envs import make_env
        >>> policy = RandomPolicy(Categorical(2, shape=(20,)))
        >>> evaluate(lambda n: make_env("CartPole-v1", n), policy, episodes=20).shape
        torch.Size([20])
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, not {episodes}")
    with (
        _acting(policy, seed, deterministic),
        nullcontext(env) if isinstance(env, EnvBase) else closing(env(episodes)) as played,
    ):
        starts = range(seed, seed + episodes, played.batch_size.numel())
        returns = [_play(played, policy, start, shrink) for start in starts]
        return torch.cat(returns)[:episodes]


@contextmanager
def watching_episodes(ended: Callable[[int], Any]) -> Iterator[None]:
    """Calls a function with the number of episodes that have just ended, to show progress.

    Args:
        ended: the function.

    Example:
        >>> from torchrl.data import Categorical
        >>> from torchrl.modules import RandomPolicy
        >>> from torchrl_tit.envs import make_env
        >>> counts = []
        >>> policy = RandomPolicy(Categorical(2, shape=(5,)))
        >>> with watching_episodes(counts.append):
        ...     _ = evaluate(lambda n: make_env("CartPole-v1", n), policy, episodes=5)
        >>> sum(counts)
        5
    """
    token = _WATCHER.set(ended)
    try:
        yield
    finally:
        _WATCHER.reset(token)


def _play(env: EnvBase, policy: Policy, seed: int, shrink: bool) -> Tensor:
    """Computes the return of one episode in each environment, float64 [N]."""
    tensordict = _reset(env, seed)
    wide = torch.float64 if env.device is None else widest_float(env.device)
    returns = torch.zeros(env.batch_size.numel(), dtype=wide, device=env.device)
    playing = torch.ones_like(returns, dtype=torch.bool)
    left = len(playing)
    while left:
        acted = _act(policy, tensordict, playing) if shrink else policy(tensordict)
        step, tensordict = env.step_and_maybe_reset(acted)
        outcome = step["next"]
        # An environment whose episode has ended starts another one, which does not count.
        reward = outcome["reward"].flatten().masked_fill(~playing, 0)
        check_rewards(reward)
        game_over = outcome.get("game_over", None)
        if game_over is None:
            returns += reward
            playing &= ~outcome["done"].flatten()
        else:
            returns = outcome["game_return"].flatten().to(wide).where(playing, returns)
            playing &= ~game_over.flatten()
        before, left = left, int(playing.sum())
        if left < before and (watcher := _WATCHER.get()) is not None:
            watcher(before - left)
    return returns


def _reset(env: EnvBase, seed: int) -> TensorDictBase:
    """Begins an episode in each environment, seeded one after the other from a first seed."""
    base = env
    while isinstance(base, TransformedEnv):
        base = base.base_env
    if not isinstance(base, BatchedEnvBase):
        return env.reset(seed=seed)
    # TorchRL gives all of its workers the same seed.
    seeds = range(seed, seed + env.batch_size.numel(), env.batch_size[1:].numel())
    return env.reset(list_of_kwargs=[{"seed": each} for each in seeds])


def _act(policy: Policy, tensordict: TensorDictBase, playing: Tensor) -> TensorDictBase:
    """Calls the policy for the environments still playing; the others get a copy of an action."""
    if playing.all():
        return policy(tensordict)
    rows = playing.nonzero().squeeze(-1)
    source = torch.zeros_like(playing, dtype=torch.int64)
    source[rows] = torch.arange(len(rows), device=rows.device)
    acted = policy(tensordict.reshape(-1)[rows])
    return acted[source].reshape(tensordict.shape)


def finished_returns(batch: TensorDictBase) -> Tensor:
    """Returns the returns of the episodes, or of the whole Atari games, that ended in a batch.

    Args:
        batch: steps of environments of :func:`~torchrl_tit.envs.make_env`, as a collector returns
            them; any shape.

    Returns:
        The undiscounted return of each episode, in the task's own rewards; [episodes].

    Raises:
        FloatingPointError: if a reward in the batch is NaN or infinite.

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", seed=0)
        >>> finished_returns(env.rollout(100, break_when_any_done=False)).sum() <= 100
        tensor(True)
    """
    outcome = batch["next"]
    check_rewards(outcome["reward"].reshape(batch.shape))
    game_over = outcome.get("game_over", None)
    if game_over is None:
        return outcome["episode_reward"][outcome["done"]]
    return outcome["game_return"][game_over]


def check_rewards(rewards: Tensor) -> None:
    """Checks that rewards are finite.

    Args:
        rewards: rewards of N copies of a task, [N] or [N, time].

    Raises:
        FloatingPointError: if one is NaN or infinite.

    Example:
        >>> check_rewards(torch.tensor([0.5, torch.inf]))
        Traceback (most recent call last):
            ...
        FloatingPointError: the reward of copy 1 is inf
    """
    finite = rewards.isfinite()
    if not finite.all():
        index = tuple(finite.logical_not().nonzero()[0].tolist())
        raise FloatingPointError(f"the reward of copy {index[0]} is {rewards[index].item()}")


def used_gpus() -> range:
    """Returns the GPUs whose random generators may be in use; none if this process uses no CUDA.

    Asking for a generator would initialize CUDA on every GPU.

    Example:
        >>> len(used_gpus()) <= torch.cuda.device_count()
        True
    """
    return range(torch.cuda.device_count() if torch.cuda.is_initialized() else 0)


@contextmanager
def _acting(policy: Policy, seed: int, deterministic: bool) -> Iterator[None]:
    """Acts without gradients, and restores all modes and random generators at the end."""
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    mode = evaluating(policy) if isinstance(policy, nn.Module) else nullcontext()
    python_state, numpy_state = random.getstate(), np.random.get_state()
    try:
        with (
            torch.random.fork_rng(used_gpus()),
            torch.no_grad(),
            set_exploration_type(exploration),
            mode,
            acting(policy),  # encodes the newest frames only
        ):
            # Makes sampled actions reproducible.
            torch.manual_seed(seed)
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)
