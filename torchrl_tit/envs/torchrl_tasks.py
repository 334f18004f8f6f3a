"""Copies of any TorchRL environment, with the keys and spec kinds of our environments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_tit.envs.action_masks import MASK, check_allowed
from torchrl_tit.envs.actions import refuse_nan
from torchrl_tit.envs.names import load_wrappers
from torchrl_tit.envs.spaces import end_flags
from torchrl_tit.envs.torchrl_specs import Convert, TensorReader, action_spec
from torchrl_tit.settings.choices import ImageLayout, VectorizationMode


class TorchRLTask(EnvBase):
    """One TorchRL environment as a task, with its observations, action and ends of episodes.

    It has the keys of :class:`~torchrl_tit.envs.GymVectorEnv`. Several observations are nested:
    ("observation", NAME), where the name of a nested one joins its keys with "/". Entries that the
    environment itself reads from step to step are kept internally.

    Args:
        env: the environment, without batch dimensions.
        clip_actions: see :class:`~torchrl_tit.envs.GymVectorEnv`, also for the next three.
        observation_keys: names of the observations to keep; all by default.
        image_layout: where images have their channels.
        mask_actions: whether an observation "action_mask" marks the allowed actions.

    Raises:
        ValueError: if its observations or actions are of an unsupported kind, or it has a batch
            size, several actions, several rewards, or separate done flags for parts of it. See also
            :class:`~torchrl_tit.envs.torchrl_specs.TensorReader`.

    Example:
        >>> from torchrl.envs import PendulumEnv
        >>> task = TorchRLTask(PendulumEnv(), observation_keys=["th", "thdot"])
        >>> task.rollout(3)["observation", "th"].shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        clip_actions: bool = True,
        observation_keys: Sequence[str] = (),
        image_layout: ImageLayout = "auto",
        mask_actions: bool = False,
    ) -> None:
        _check(env)
        read = TensorReader(
            env.full_observation_spec,
            keys=observation_keys,
            image_layout=image_layout,
            mask_actions=mask_actions,
        )
        spec, write = action_spec(env.full_action_spec[env.action_key], clip=clip_actions)
        super().__init__(device=env.device, batch_size=torch.Size([]))
        self._env, self._read = env, read
        self.action_writer = write
        """Converts actions, [*batch, *action_spec], to those of the environment."""
        self._carried: TensorDictBase | None = None  # what the environment reads next
        entries = {"observation": read.spec}
        if read.mask_key is not None:
            self._options = _options(spec)
            mask = sum(self._options)
            found = env.full_observation_spec[read.mask_key].shape.numel()
            if found != mask:
                raise ValueError(f'The task\'s "{MASK}" has {found} entries, not {mask}.')
            entries[MASK] = Binary(mask, shape=(mask,), dtype=torch.bool)
        place = (lambda x: x) if self.device is None else (lambda x: x.to(self.device))
        self.observation_spec = place(Composite(entries))
        self.action_spec = place(spec)
        self.reward_spec = place(Unbounded((1,), dtype=torch.float32))
        self.done_spec = place(end_flags())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self._carried is not None
        action = tensordict["action"]
        if action.is_floating_point():
            refuse_nan(action)
        self._carried.set(self._env.action_key, self.action_writer(action))
        stepped = self._env.step(self._carried)
        outcome = stepped["next"]
        self._carried = self._env.step_mdp(stepped)
        reward = outcome.get(self._env.reward_key).to(torch.float32).reshape(1)
        return self._tensordict(outcome, reward=reward)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **kwargs: Any
    ) -> TensorDictBase:
        if seed is not None:
            self._env.set_seed(seed)
        self._carried = self._env.reset()
        return self._tensordict(self._carried)

    def _tensordict(self, outcome: TensorDictBase, **entries: Any) -> TensorDict:
        entries["observation"] = self._read(outcome)
        if self._read.mask_key is not None:
            entries[MASK] = outcome.get(self._read.mask_key).bool().reshape(-1)
        done = outcome.get("done").reshape(1)
        if MASK in entries:
            check_allowed(entries[MASK].numpy(force=True), done.numpy(force=True), self._options)
        truncated = outcome.get("truncated", torch.zeros_like(done)).reshape(1)
        terminated = outcome.get("terminated", done & ~truncated).reshape(1)
        entries |= {"done": done, "terminated": terminated, "truncated": truncated}
        return TensorDict(entries, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._env.set_seed(seed)

    def render(self) -> np.ndarray:
        """Renders the task with its own ``render``, or else returns its observation "pixels".

        Returns:
            uint8 [height, width, 3].

        Raises:
            ValueError: if it has neither.
        """
        own = getattr(self._env, "render", None)
        picture = own() if callable(own) else None
        if picture is None and self._carried is not None:
            picture = self._carried.get("pixels", None)
        if picture is None:
            raise ValueError('The task has neither a method "render" nor an observation "pixels".')
        picture = np.asarray(picture)
        return np.moveaxis(picture, 0, -1) if picture.shape[0] in (1, 3) else picture

    picture = render  # TorchRL's batches of environments ask their copies for what they lack

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the task."""
        if not self._env.is_closed:
            self._env.close()
        super().close(raise_if_closed=raise_if_closed)


class _SeededCopies(BatchedEnvBase):
    """Copies whose resets take a seed: copy i gets ``seed + i``, or entry i of a sequence."""

    action_writer: Convert
    """That of a copy, see :class:`TorchRLTask`."""

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        seed: int | Sequence[int] | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_workers)
        if seed is not None:
            kwargs["list_of_kwargs"] = [{"seed": own} for own in seed]
        return super()._reset(tensordict, **kwargs)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds copy i with ``seed + i``."""
        self.reset(seed=seed)
        return None if seed is None else seed + self.num_workers

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the copies, if they have been started; closing twice is allowed."""
        if not self.is_closed:
            threads = torch.get_num_threads()
            super().close(raise_if_closed=raise_if_closed)
            torch.set_num_threads(threads)  # TorchRL raises it by the number of copies


class SerialTasks(_SeededCopies, SerialEnv):
    """Copies of a task that are stepped one after the other."""

    render_fps = 30
    """Frames per second of a film."""

    def render(self) -> np.ndarray:
        """Renders the copies; uint8 [N, height, width, 3].

        Raises:
            ValueError: if they cannot be rendered.
        """
        return np.stack(self.picture())  # of each copy


class ParallelTasks(_SeededCopies, ParallelEnv):
    """Copies of a task that are stepped in parallel, in one process each."""


def make_torchrl_tasks(
    make: Callable[..., EnvBase],
    num_envs: int,
    *,
    name: str,
    wrappers: Sequence[str] = (),
    vectorization_mode: VectorizationMode = "sync",
    device: torch.device | str | None = None,
    task_settings: dict[str, Any],
    **reading: Any,
) -> EnvBase:
    """Makes copies of a TorchRL environment, as an environment of batch size [N].

    Args:
        make: a class or function that makes an environment without batch dimensions.
        num_envs: N.
        name: the task's name, for error messages.
        wrappers: TorchRL transforms around each copy, in the format of
            :func:`~torchrl_tit.envs.names.load_wrappers`.
        vectorization_mode: ``"sync"`` steps the copies in this process (`SerialEnv`), ``"async"``
            in one process each (`ParallelEnv`).
        device: device of the tensors.
        task_settings: passed to ``make``. If ``make`` has no ``max_episode_steps``, TorchRL's
            `StepCounter` truncates the episodes.
        **reading: see :class:`TorchRLTask`.

    Returns:
        The environment.

    Raises:
        ValueError: see :class:`TorchRLTask`; or if a setting or a wrapper is invalid.

    Example:
        >>> from torchrl.envs import PendulumEnv
        >>> env = make_torchrl_tasks(PendulumEnv, 2, name="pendulum", task_settings={})
        >>> env.rollout(3).batch_size
        torch.Size([2, 3])
    """
    copy = partial(_copy, make, name, tuple(wrappers), task_settings, reading)
    with closing(copy()) as made:  # so that errors are raised here, not in other processes
        writer = made.action_writer
    kind = SerialTasks if vectorization_mode == "sync" else ParallelTasks
    # Without num_threads, TorchRL lowers the number of threads of this process, too.
    tasks = kind(num_envs, copy, device=device, num_threads=torch.get_num_threads())
    tasks.action_writer = writer
    return tasks


def _copy(
    make: Callable[..., EnvBase],
    name: str,
    wrappers: tuple[str, ...],
    settings: dict[str, Any],
    reading: dict[str, Any],
) -> TorchRLTask:
    """Makes one copy, in the process that steps it."""
    wraps, transforms = load_wrappers(wrappers)
    if wraps:
        raise ValueError(
            f"Task {name!r} is a TorchRL environment, which takes TorchRL transforms and no "
            "gymnasium.Wrapper."
        )
    parameters = inspect.signature(make).parameters
    limit = None if "max_episode_steps" in parameters else settings.get("max_episode_steps")
    # It may lack a limit, and renders in its own way.
    unknown = {"max_episode_steps", "render_mode"} - {*parameters}
    settings = {key: value for key, value in settings.items() if key not in unknown}
    try:
        env = make(**settings)
    except Exception as error:  # an environment can raise anything
        raise ValueError(
            f"Task {name!r} cannot be made: {type(error).__name__}: {error}"
        ) from error
    if not isinstance(env, EnvBase):
        raise ValueError(
            f"Task {name!r} must make a TorchRL EnvBase, but made a {type(env).__name__}."
        )
    if limit is not None:
        transforms.append(StepCounter(limit))
    if transforms:
        env = TransformedEnv(env, Compose(*transforms))
    try:
        return TorchRLTask(env, **reading)
    except ValueError as error:
        raise ValueError(f"Task {name!r}: {error}") from error


def _check(env: EnvBase) -> None:
    """Raises ValueError if an environment is not one task with one action and one reward."""
    if env.batch_size:
        raise ValueError(
            f"it has the batch size {list(env.batch_size)}; expected an environment without batch "
            "dimensions, of which copies are made"
        )
    actions = list(env.full_action_spec.keys(True, True))
    if len(actions) != 1:
        raise ValueError(f"it has the actions {sorted(map(str, actions))}; expected one")
    rewards = list(env.full_reward_spec.keys(True, True))
    if len(rewards) != 1 or env.full_reward_spec[rewards[0]].shape.numel() != 1:
        raise ValueError(
            "it has several rewards in a step; expected one number, as for a single agent"
        )
    ends = [key for key in env.full_done_spec.keys(True, True) if isinstance(key, tuple)]
    if ends or "done" not in env.full_done_spec:
        raise ValueError(
            f"it has the ends of episodes {sorted(map(str, env.full_done_spec.keys(True, True)))}; "
            'expected "done", and "terminated" and "truncated" if it tells them apart'
        )


def _options(spec: Any) -> list[int]:
    """The number of options of each entry of an action."""
    if type(spec) is Categorical:
        return [int(spec.space.n)]
    if hasattr(spec, "nvec"):
        return torch.as_tensor(spec.nvec).flatten().tolist()
    raise ValueError("only discrete actions can be masked; leave out mask_actions")
