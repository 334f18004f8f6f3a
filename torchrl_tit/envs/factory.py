"""Tasks by name, with histories of their observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import (
    Compose,
    EnvBase,
    RandomTruncationTransform,
    RewardSum,
    StepCounter,
    TerminateTransform,
    Transform,
    TransformedEnv,
)

from torchrl_tit.envs.action_masks import MASK
from torchrl_tit.envs.atari import FRAME_SKIP, MAX_NUM_FRAMES, AtariEnv, AtariGames
from torchrl_tit.envs.given import make_unknown_task
from torchrl_tit.envs.gymnasium_tasks import make_gymnasium_tasks
from torchrl_tit.envs.names import find_task, load_wrappers, task_spec, unknown
from torchrl_tit.envs.spaces import observation_keys as keys_of
from torchrl_tit.envs.torchrl_tasks import make_torchrl_tasks
from torchrl_tit.envs.vector import GymVectorEnv
from torchrl_tit.extras import install
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import ImageLayout, Padding, VectorizationMode
from torchrl_tit.settings.numbers import Copies, Seed
from torchrl_tit.transforms.hide_velocities import HideVelocities
from torchrl_tit.transforms.history import History


@checked_arguments
def make_env(
    name: str,
    num_envs: Copies = 1,
    *,
    seed: Seed | None = None,
    num_frames: int = 1,
    padding: Padding = "same",
    keep_histories: bool = True,
    hide_velocities: bool = False,
    clip_actions: bool = True,
    observation_keys: Sequence[str] = (),
    image_layout: ImageLayout = "auto",
    mask_actions: bool = False,
    wrappers: Sequence[str] = (),
    vectorization_mode: VectorizationMode = "sync",
    device: torch.device | str | None = None,
    **kwargs: Any,
) -> TransformedEnv:
    """Makes copies of a task, with histories of its observations.

    A task is any Gymnasium environment, an Atari game, or any TorchRL environment.

    The environment itself (``.base_env``) writes observations only. Transforms write the rest:
    :class:`~torchrl_tit.transforms.HideVelocities` if requested, TorchRL's `RewardSum`, and
    :class:`~torchrl_tit.transforms.History`. Add further ones with ``append_transform``.

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``observation``         [N, *obs]           or nested, if there are several: their kinds are
                                                those of :func:`~torchrl_tit.envs.observation_specs`
    ``history``             [N, K, *obs]        the last K observations, the newest last; likewise
    ``episode_reward``      [N, 1]              float32, the undiscounted return so far
    ``action``              [N] or [N, A]       int64, int8 (MultiBinary) or float32 (Box)
    ``action_mask``         [N, n]              bool, what is allowed, with ``mask_actions``
    ``reward``              [N, 1]              float32
    ``terminated``          [N, 1]              bool, the task ended the episode
    ``truncated``           [N, 1]              bool, the time limit ended the episode
    ``done``                [N, 1]              bool, either
    ======================  ==================  ===================================================

    Args:
        name: a name that Gymnasium has registered, such as "CartPole-v1" or "Hopper-v5". An empty
            name is a task of which only the spaces are known: see
            :func:`~torchrl_tit.envs.given.make_unknown_task`. In
            "module:Name-v0", the module registers the name. In "module:Name", the name is that of a
            class or function in the module that makes a TorchRL `EnvBase`: see
            :class:`~torchrl_tit.envs.torchrl_tasks.TorchRLTask`. The module is imported, so pass no
            names from strangers. Names that begin with "ALE/", such as "ALE/Pong-v5", are Atari
            games with the preprocessing of :class:`~torchrl_tit.envs.AtariGames`.
        num_envs: N, the number of copies; the batch size is [N], also for N = 1.
        seed: copy i is seeded with ``seed + i``; without a seed, all differ from run to run.
        num_frames: K, the number of observations in a history.
        padding: how a history is padded before an episode's first step: see
            :class:`~torchrl_tit.transforms.History`.
        keep_histories: whether a step keeps its histories after it is taken. If not,
            ``step_and_maybe_reset`` removes them, also from "next", and a collector stores
            observations only; the tensordict on which the policy acts has its histories in either
            case.
        hide_velocities: whether observations and histories lack the velocities: see
            :class:`~torchrl_tit.transforms.HideVelocities`.
        clip_actions: whether continuous actions are clipped before they are passed to the task: see
            :class:`~torchrl_tit.envs.GymVectorEnv`.
        observation_keys: names of the observations to keep, for a task with several; by default,
            all. See :class:`~torchrl_tit.envs.GymVectorEnv`.
        image_layout: where the task's images have their channels: ``"HWC"``, ``"CHW"``, or
            ``"auto"``, which infers it from their shape.
        mask_actions: whether to write which actions the task allows.
        wrappers: Gymnasium wrappers and TorchRL transforms around each copy, the innermost first,
            as "module:Class" or "module:Class(argument=literal)".
        vectorization_mode: ``"sync"`` steps the copies one after the other in this process,
            ``"async"`` in parallel, in one process each, with the same results, which pays off for
            slow tasks. Atari games always run in parallel, in threads.
        device: device of the tensors; by default they stay on the CPU and the device is None.
        **kwargs: passed to `gymnasium.make`, such as ``max_episode_steps=200``, to the class or
            function of the TorchRL environment, or to :class:`~torchrl_tit.envs.AtariGames`.

    Returns:
        The environment. Atari games have further keys: see
        :class:`~torchrl_tit.envs.AtariEnv`.

    Raises:
        ValueError: if the name or the mode is unknown, a wrapper or a setting of the task is
            wrong, a package that the task needs is missing, ``num_envs``, ``num_frames`` or the
            padding is invalid, observations or actions are of an unsupported kind, ``"async"`` is
            given for Atari games, or it is not known which observations are velocities.

    Example:
        >>> env = make_env("CartPole-v1", num_envs=8, seed=0, num_frames=4)
        >>> env.reset()["history"].shape
        torch.Size([8, 4, 4])
        >>> make_env("CartPole-v2")
        Traceback (most recent call last):
        ...
        ValueError: Unknown task 'CartPole-v2'; did you mean CartPole-v1 or CartPole-v0...
    """
    wraps, transforms = load_wrappers(wrappers)
    reading: dict[str, Any] = {
        "clip_actions": clip_actions,
        "observation_keys": observation_keys,
        "image_layout": image_layout,
        "mask_actions": mask_actions,
        "device": device,
    }
    env: EnvBase
    if (not name or is_atari(name)) and (wraps or observation_keys or mask_actions):
        raise ValueError(
            f"{name or 'a task without a name'} has one observation, read in one way: it takes no "
            "gymnasium.Wrapper (only TorchRL transforms), observation_keys or mask_actions"
        )
    if not name:
        kwargs.pop("render_mode", None)  # its render() says that there is nothing to see
        try:
            env = make_unknown_task(num_envs, clip_actions=clip_actions, device=device, **kwargs)
        except TypeError as error:  # it has none of the settings of an environment
            raise ValueError(f"a task without a name consists of its spaces: {error}") from error
    elif is_atari(name):
        if vectorization_mode == "async":
            raise ValueError(
                f"{name} runs in threads, side by side; leave vectorization_mode at 'sync'."
            )
        for wrapper, transform in zip(wrappers, transforms, strict=True):
            _check_keeps_games(name, wrapper, transform)
        env = AtariEnv(make_games(name, num_envs, **kwargs), device=device)
    else:
        task = find_task(name)
        if isinstance(task, str):
            tasks = make_gymnasium_tasks(task, num_envs, vectorization_mode, wraps, **kwargs)
            env = GymVectorEnv(tasks, **reading)
        else:
            env = make_torchrl_tasks(
                task,
                num_envs,
                name=name,
                wrappers=wrappers,
                vectorization_mode=vectorization_mode,
                task_settings=kwargs,
                **reading,
            )
            transforms = []  # they are inside
    if seed is not None:
        env.set_seed(seed)
    env = TransformedVectorEnv(
        env, Compose(*transforms), transient_keys=() if keep_histories else ("history",)
    )
    if transforms:
        _check_fit(env, name, wrappers)
    if hide_velocities:
        whole = ("observation", "observation")  # beside other observations, such as PreviousStep's
        keys = [key for key in keys_of(env) if key in ("observation", whole)]
        env.append_transform(HideVelocities(name, keys))
        if not keys:
            found = ", ".join(str(key[-1]) for key in keys_of(env))
            raise ValueError(
                f"hide_velocities takes entries from the observation of {name}, but its wrappers "
                f"{list(wrappers)} make several with other names ({found}): leave one of them out"
            )
    env.append_transform(RewardSum())
    env.append_transform(History(num_frames, keys_of(env), padding=padding))
    return env


def _check_keeps_games(name: str, wrapper: str, transform: Transform) -> None:
    """Raises ValueError if a transform changes the rewards or the ends of an Atari game."""
    ends = isinstance(transform, RandomTruncationTransform | TerminateTransform)
    if ends or (isinstance(transform, StepCounter) and transform.max_steps):
        raise ValueError(
            f"Wrapper {wrapper!r} ends a game of {name} that goes on, and its score counts whole "
            "games: limit them with max_num_frames_per_episode (4 frames a step)"
        )
    if "reward" in transform.out_keys:
        raise ValueError(
            f"Wrapper {wrapper!r} changes the rewards of {name}, but not its score, which is the "
            "game's own: leave it out (ppo and dqn recipes have clip_rewards)"
        )


def _check_fit(env: EnvBase, name: str, wrappers: Sequence[str]) -> None:
    """Raises ValueError if transforms cannot be applied to a task."""
    try:
        _ = env.input_spec, env.output_spec
    except Exception as error:  # a transform can raise anything
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        env.close()
        raise ValueError(
            f"the transforms in wrappers {list(wrappers)} do not fit {name or 'the task'}: {reason}"
        ) from error


class TransformedVectorEnv(TransformedEnv):
    """TorchRL's `TransformedEnv`, whose taken steps can lack entries that only the policy reads.

    Args:
        base_env: the environment.
        transform: as in `TransformedEnv`.
        transient_keys: entries that only the policy reads, such as histories. They are removed from
            a step after it is taken, at its root and under "next". The tensordict to act on next
            has them, so a collector works as usual but does not store them.
        **settings: as in `TransformedEnv`.

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", num_envs=8, num_frames=4, keep_histories=False)
        >>> step, following = env.step_and_maybe_reset(env.rand_action(env.reset()))
        >>> "history" in step, "history" in following
        (False, True)
    """

    def __init__(
        self,
        base_env: EnvBase,
        transform: Transform | None = None,
        *,
        transient_keys: Sequence[NestedKey] = (),
        **settings: Any,
    ) -> None:
        super().__init__(base_env, transform, **settings)
        self.transient_keys = tuple(transient_keys)
        """Entries that are removed from a step after it is taken."""

    @property
    def _has_dynamic_specs(self) -> bool:
        """Whether steps differ from the specs, so that no collector allocates buffers by them.

        Entries that steps lack would stay zero in these buffers. TorchRL has no public setting for
        this but ``use_buffers=False``, which each collector would need.
        """
        return bool(self.transient_keys) or super()._has_dynamic_specs

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps all environments and resets those whose episode ended.

        Args:
            tensordict: [N], with the action.

        Returns:
            The tensordict with its "next", both without ``transient_keys``, and the one to act on
            next.
        """
        taken, following = super().step_and_maybe_reset(tensordict)
        for key in self.transient_keys:
            for part in (taken, taken.get("next")):
                if part.get(key, None) is not None:
                    part.del_(key)
        return taken, following

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Draws an action; an allowed one, if the tensordict has an "action_mask".

        TorchRL's `ActionMask` could do this, but keeps the mask in the spec.

        Args:
            tensordict: the environment's output, [N].

        Returns:
            The tensordict with the action.
        """
        if tensordict is None or tensordict.get(MASK, None) is None:
            return super().rand_action(tensordict)
        spec = self.action_spec.clone()
        spec.update_mask(tensordict[MASK])
        return tensordict.set(self.action_key, spec.rand())


def is_atari(name: str) -> bool:
    """Returns whether a name is that of an Atari game, which begins with "ALE/".

    Args:
        name: a name that Gymnasium may have registered.

    Returns:
        Whether it is an Atari game.

    Example:
        >>> is_atari("ALE/Pong-v5"), is_atari("Hopper-v5")
        (True, False)
    """
    return name.startswith("ALE/")


def time_limit(name: str) -> int | None:
    """Returns the number of steps after which the episodes of a task are truncated.

    Args:
        name: a name that :func:`make_env` accepts.

    Returns:
        The number of steps, or None for a task without a time limit.

    Example:
        >>> time_limit("Hopper-v5"), time_limit("ALE/Pong-v5")
        (1000, 27000)
    """
    if not name:
        return None
    if is_atari(name):
        return MAX_NUM_FRAMES // FRAME_SKIP
    task = find_task(name)
    return task_spec(task).max_episode_steps if isinstance(task, str) else None


def make_games(name: str, num_envs: int = 1, **kwargs: Any) -> AtariGames:
    """Makes copies of an Atari game by Gymnasium's name, as :func:`make_env` does.

    Args:
        name: a name such as "ALE/Pong-v5".
        num_envs: the number of copies.
        **kwargs: passed to :class:`~torchrl_tit.envs.AtariGames`.

    Returns:
        The games.

    Raises:
        ValueError: if the name or a setting is unknown, or ale-py is missing.

    Example:
        >>> make_games("ALE/Pong-v5").single_observation_space
        Box(0, 255, (84, 84), uint8)
    """
    try:
        import ale_py  # an optional extra
    except ImportError as error:
        raise ValueError(f"Task {name!r} needs ale-py: {install('ale_py')} ({error}).") from error
    gymnasium.register_envs(ale_py)
    if name not in gymnasium.registry:
        raise unknown(name)
    try:
        return AtariGames(gymnasium.registry[name].kwargs["game"], num_envs, **kwargs)
    except TypeError as error:  # no such setting
        raise ValueError(f"Task {name!r} cannot be made: {error}") from error
