"""Returns of a policy over whole episodes, as the paper measures them."""

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_tit.modules import acting


def evaluate(
    env: EnvBase | Callable[[int], EnvBase],
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int = 100,
    *,
    seed: int = 0,
    reward_key: NestedKey = "reward",
    shrink: bool = False,
    deterministic: bool = True,
) -> Tensor:
    """Plays whole episodes with a policy that learns nothing from them.

    Episode i starts from the seed ``seed + i``, in an environment of its own, so the same policy
    gets the same returns whatever the number of environments. As many episodes as there are
    environments run side by side, until the last of them ends: which episodes count does not depend
    on how long they take. In Atari (:class:`~torchrl_tit.envs.AtariEnv`) an episode is a whole
    game with all of its points, however many lives it takes. Training goes on afterwards as if
    nothing had been evaluated: the policy gets its training mode back, and the global random
    generators of PyTorch, NumPy and Python their states.

    Args:
        env: An environment of any batch size, whose `reset` takes a seed as those of
            :func:`~torchrl_tit.envs.make_env` and TorchRL's `GymWrapper` do, and which pays the
            task's own rewards, not clipped ones. Its episodes are cut off by a reset. Or a function
            that makes one from the number of environments; it is called with ``episodes``, and what
            it made is closed at the end.
        policy: Writes the action into the tensordict it is given. It acts in evaluation mode.
        episodes: Number of episodes.
        seed: Seed of the first episode.
        reward_key: Where the reward stands in "next".
        shrink: Whether the policy is asked only about the environments whose episode still counts,
            which saves time where episodes differ in length. It must take batches of any size, and
            keep no state of its own from step to step.
        deterministic: Whether the distribution's deterministic action is taken (argmax, or the
            mean), instead of one that is drawn.

    Returns:
        The undiscounted return of each episode; float64 [episodes], on the environment's device.

    Raises:
        ValueError: If ``episodes`` is less than 1.

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
        raise ValueError(f"episodes must be at least 1, but is {episodes}.")
    with _acting(policy, seed, deterministic):
        if isinstance(env, EnvBase):
            return _play_all(env, policy, episodes, seed, reward_key, shrink)
        made = env(episodes)
        try:
            return _play_all(made, policy, episodes, seed, reward_key, shrink)
        finally:
            made.close()


def _play_all(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int,
    seed: int,
    reward_key: NestedKey,
    shrink: bool,
) -> Tensor:
    """The return of each episode; as many run at once as there are environments; [episodes]."""
    starts = range(seed, seed + episodes, env.batch_size.numel())
    returns = [_play(env, policy, start, reward_key, shrink) for start in starts]
    return torch.cat(returns)[:episodes]


def _play(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    seed: int,
    reward_key: NestedKey,
    shrink: bool,
) -> Tensor:
    """The return of one episode in each of the environments; float64 [N]."""
    tensordict = env.reset(seed=seed)
    returns = torch.zeros(env.batch_size.numel(), dtype=torch.float64, device=env.device)
    playing = torch.ones_like(returns, dtype=torch.bool)
    while playing.any():
        acted = _act(policy, tensordict, playing) if shrink else policy(tensordict)
        step, tensordict = env.step_and_maybe_reset(acted)
        outcome = step["next"]
        # An environment whose episode has ended plays on, but nothing of that counts.
        game_over = outcome.get("game_over", None)
        if game_over is None:
            returns += outcome[reward_key].flatten() * playing
            playing &= ~outcome["done"].flatten()
        else:
            returns = outcome["game_return"].flatten().double().where(playing, returns)
            playing &= ~game_over.flatten()
    return returns


def _act(
    policy: Callable[[TensorDictBase], TensorDictBase], tensordict: TensorDictBase, playing: Tensor
) -> TensorDictBase:
    """Asks the policy about some environments; the others go on as copies of one of these."""
    if playing.all():
        return policy(tensordict)
    rows = playing.nonzero().squeeze(-1)
    source = torch.zeros_like(playing, dtype=torch.int64)
    source[rows] = torch.arange(len(rows), device=rows.device)
    acted = policy(tensordict.reshape(-1)[rows])
    return acted[source].reshape(tensordict.shape)


def finished_returns(batch: TensorDictBase) -> Tensor:
    """Picks the returns of the episodes, or of the whole Atari games, that ended in a batch.

    Args:
        batch: Steps of :func:`~torchrl_tit.envs.make_env`'s environments, as a collector hands them
            over; any shape.

    Returns:
        The undiscounted return of each, in the task's own rewards; [episodes].

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", seed=0)
        >>> finished_returns(env.rollout(100, break_when_any_done=False)).sum() <= 100
        tensor(True)
    """
    outcome = batch["next"]
    game_over = outcome.get("game_over", None)
    if game_over is None:
        return outcome["episode_reward"][outcome["done"]]
    return outcome["game_return"][game_over]


@contextmanager
def _acting(
    policy: Callable[[TensorDictBase], TensorDictBase], seed: int, deterministic: bool
) -> Iterator[None]:
    """Actions without gradients, and everything as it was before at the end."""
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    modules = list(policy.modules()) if isinstance(policy, nn.Module) else []
    modes = [module.training for module in modules]
    python_state, numpy_state = random.getstate(), np.random.get_state()
    devices = range(torch.cuda.device_count())
    try:
        with (
            torch.random.fork_rng(devices),
            torch.no_grad(),
            set_exploration_type(exploration),
            acting(policy),  # encodes the newest frames only
        ):
            # A policy that draws numbers draws the same ones each time.
            torch.manual_seed(seed)
            if isinstance(policy, nn.Module):
                policy.eval()
            yield
    finally:
        for module, mode in zip(modules, modes, strict=True):
            module.training = mode
        random.setstate(python_state)
        np.random.set_state(numpy_state)
