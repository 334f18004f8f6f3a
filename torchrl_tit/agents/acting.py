"""A policy that acts on the observations of a machine, one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_tit.envs.given import Feed, GivenEnds, GivenTask
from torchrl_tit.modules.action_specs import describe
from torchrl_tit.networks.building import evaluating

_READ = ("observation", "action_mask")


class Actor:
    """Acts on NumPy arrays, and keeps what the policy remembers.

    Histories, recurrent states and the past actions and returns-to-go of a Decision Transformer are
    kept by the transforms of the policy's own environment, so it acts as in an evaluation.

    Args:
        policy: the policy.
        make_env: makes its task, given the number of copies, with all entries that it reads.

    Example:
        >>> from torchrl_tit import load_agent
        >>> agent = load_agent("cartpole")
        >>> actor = Actor(agent.policy, agent.make_env)
        >>> actor.act(np.zeros(4)).shape, actor.act([0.1, np.nan, 0.0, 0.0]).shape
        ((), ())
    """

    def __init__(self, policy: TensorDictModuleBase, make_env: Callable[[int], EnvBase]) -> None:
        self._policy, self._make_env = policy, make_env
        self._env: TransformedEnv | None = None
        self._steps: TensorDictBase | None = None
        self._begins = torch.zeros(1, 1, dtype=torch.bool)

    def reset(self, which: Any = None) -> None:
        """Begins an episode with the next observation.

        Args:
            which: in which of several copies, bool [N]; by default in all, of which there may then
                be another number.

        Raises:
            ValueError: if it is not bool [N].
        """
        if which is None or self._env is None:
            self._env = self._steps = None
        else:
            begins = torch.as_tensor(np.asarray(which))
            if begins.dtype != torch.bool or begins.numel() != len(self._begins):
                raise ValueError(
                    f"which must be {len(self._begins)} bools, whether each copy begins an "
                    f"episode, not {which}"
                )
            self._begins |= begins.reshape(self._begins.shape)

    def act(self, observation: Any, *, reward: Any = 0.0, action_mask: Any = None) -> NDArray:
        """Returns the most likely action.

        Args:
            observation: one observation, or those of N copies, [N, ...], as the agent's environment
                writes them, of any dtype; for a task with several, each by its name. Where it is
                NaN, or None for all of it, the last value is held.
            reward: the reward since the last action, a number or [N], which only a Decision
                Transformer reads.
            action_mask: which actions are allowed, for an agent that reads it, [actions] or
                [N, actions]; of several choices, those of all in one row, or a tuple, as
                Gymnasium has them.

        Returns:
            The action in the task's own form, clipped to its bounds; [N, ...] for several copies.

        Raises:
            ValueError: if the observation lacks a name, has another shape, is infinite, or has
                numbers that its integers cannot hold, the number of copies changes without
                :meth:`reset`, there is no last value to hold, the reward is not finite, or the mask
                is missing, has another size, or allows nothing.
        """
        if self._env is None:
            self._start(observation)
        assert self._env is not None
        given = {"observation": self._read(observation)}
        if "action_mask" in self._specs:
            if action_mask is None:
                raise ValueError("the agent reads which actions are allowed: give action_mask")
            if isinstance(action_mask, tuple):  # Gymnasium's of several choices
                action_mask = np.concatenate(action_mask, -1)
            if not np.isin(action_mask, (0, 1)).all():
                raise ValueError(f"action_mask must be 0 or 1 for each action, not {action_mask}")
            mask = torch.as_tensor(np.asarray(action_mask, bool))
            shape = self._env.observation_spec["action_mask"].shape
            if mask.numel() != shape.numel():
                raise ValueError(
                    f"action_mask has the shape {list(mask.shape)}, but must have {list(shape)}"
                )
            if not mask.any(-1).all():
                raise ValueError("action_mask allows no action: give every copy at least one")
            given["action_mask"] = mask.reshape(shape)
        rewards = torch.as_tensor(np.asarray(reward, np.float32)).reshape(-1, 1)
        if len(rewards) not in (1, copies := len(self._begins)):
            raise ValueError(
                f"there are {len(rewards)} rewards, but {copies} copies: give {copies}"
            )
        if not rewards.isfinite().all():
            raise ValueError(f"the reward is {reward}, not a finite number, which later steps read")
        given["reward"] = rewards.expand(copies, 1)
        given["truncated"] = self._begins
        self._given = given
        with (
            torch.no_grad(),
            evaluating(self._policy),
            set_exploration_type(ExplorationType.DETERMINISTIC),
        ):
            if self._steps is None:
                steps = self._env.reset()
            else:  # also resets the copies in which an episode begins
                _, steps = self._env.step_and_maybe_reset(self._steps)
            self._steps = self._policy(steps)
        taken = self._env.transform.inv(self._steps.copy())["action"]  # as the environment does
        action = self._to_task(taken.cpu()).clone().numpy()  # the caller may change it
        self._begins = torch.zeros_like(self._begins)
        return action if self._batched else action[0]

    def _start(self, observation: Any) -> None:
        """Builds the environment for as many copies as there are observations."""
        base, transforms = parts_of(self._make_env)
        self._specs = _specs(base)
        spec = self._specs["observation"]
        several = isinstance(spec, Composite)
        name = next(iter(spec.keys())) if several else None
        if several:
            _check_names(observation, list(spec.keys()))
        elif observation is None:
            raise ValueError("the first observation must be an array, not None")
        first = np.asarray(observation[name] if several else observation)
        ndim = (spec[name] if several else spec).ndim
        self._batched = first.ndim > ndim
        copies = len(first) if self._batched else 1
        if not copies:
            raise ValueError("there are observations of 0 copies: give those of at least one")
        writer = getattr(base, "action_writer", None)
        self._to_task: Callable[[Tensor], Tensor] = writer or (lambda action: action)
        self._env = _given(base, transforms, self._feed, copies)
        self._begins = torch.zeros(copies, 1, dtype=torch.bool)
        self._last: dict[str, Tensor] = {}

    def _feed(self, begins: bool) -> Mapping[str, Any]:
        return self._given

    def _read(self, observation: Any) -> Any:
        spec = self._specs["observation"]
        if not isinstance(spec, Composite):
            return self._hold("observation", observation, spec)
        values = dict.fromkeys(spec.keys()) if observation is None else observation
        _check_names(values, list(spec.keys()))
        return {name: self._hold(name, values[name], leaf) for name, leaf in spec.items()}

    def _hold(self, name: str, value: Any, spec: Any) -> Tensor:
        """Converts an observation, [N, *obs], and fills in what is missing."""
        last = self._last.get(name)
        shape = (len(self._begins), *spec.shape)
        if value is None:
            missing = torch.ones(shape, dtype=torch.bool)
            frame = torch.zeros(shape, dtype=spec.dtype)
        else:
            array = np.asarray(value)
            if spec.shape == (1,) and not self._batched:  # Gymnasium's categories are numbers
                array = array.reshape(array.shape or 1)
            if array.dtype.kind not in "biuf":
                raise ValueError(f"the {name} must be numbers, not {array.dtype}")
            if array.shape != (shape if self._batched else shape[1:]):
                expected = list(shape) if self._batched else list(shape[1:])
                hint = ", with its channels first" if spec.ndim == 3 else ""  # an image
                if array.shape[-spec.ndim :] == spec.shape:
                    hint = ": call reset() before another number of copies"
                raise ValueError(
                    f"the {name} has the shape {list(array.shape)}, but must have {expected}{hint}"
                )
            numbers = torch.as_tensor(np.ascontiguousarray(array)).reshape(shape)
            missing = numbers.isnan()
            frame = numbers.to(spec.dtype, copy=True)  # the caller may reuse the array
            floats = spec.dtype.is_floating_point
            if floats and frame.isinf().any():
                raise ValueError(
                    f"the {name} is infinite in {spec.dtype}: give what the data of training have "
                    "there, or NaN to hold the last value"
                )
            if not floats and len(changed := numbers[(frame != numbers) & ~missing]):
                kind = str(spec.dtype).removeprefix("torch.")
                raise ValueError(
                    f"the {name} is {kind}, but has {changed[0].item():g}: give it as the task "
                    "writes it, images from 0 to 255"
                )
        if missing.any():
            begins = self._begins if last is not None else torch.ones_like(self._begins)
            if (missing.flatten(1).any(1, keepdim=True) & begins).any():
                raise ValueError(
                    f"the first {name} of an episode is missing or has NaN, and there is no last "
                    "one to hold: wait for a whole one"
                )
            assert last is not None
            frame = torch.where(missing, last, frame)
        if not spec.dtype.is_floating_point and not spec.expand(shape).is_in(frame):
            raise ValueError(
                f"the {name} is {frame.tolist()}, which its space lacks: {describe(spec)}"
            )
        self._last[name] = frame
        return frame


def _check_names(observation: Any, names: Sequence[str]) -> None:
    """Raises ValueError if an observation is no mapping, or lacks one of these names."""
    if not isinstance(observation, Mapping):
        raise ValueError(
            f"the observation must be a mapping with {', '.join(names)}, not {observation!r}"
        )
    if missing := [name for name in names if name not in observation]:
        raise ValueError(
            f"the observation has {', '.join(map(str, observation))}, but not {missing[0]}: give "
            "it, or None to hold its last value"
        )


def make_given_env(make_env: Callable[[int], EnvBase], feed: Feed, num_envs: int = 1) -> EnvBase:
    """Makes an environment whose observations a function gives, with all that a policy reads.

    Args:
        make_env: makes the policy's own environment, given the number of copies.
        feed: gives the observations; see :class:`~torchrl_tit.envs.given.GivenTask`.
        num_envs: number of copies.

    Example:
        >>> from torchrl_tit import load_agent
        >>> agent = load_agent("cartpole")
        >>> env = make_given_env(agent.make_env, lambda begins: {"observation": torch.ones(1, 4)})
        >>> agent.policy(env.reset())["action"].shape
        torch.Size([1])
    """
    return _given(*parts_of(make_env), feed, num_envs)


def parts_of(make_env: Callable[..., EnvBase]) -> tuple[EnvBase, Compose]:
    """Returns an environment that is closed, and its transforms, which can join another."""
    with closing(make_env(1)) as made:
        base, transforms = made.base_env, made.transform
        transforms.reset_parent()
    return base, transforms


def _specs(base: EnvBase) -> dict[str, TensorSpec]:
    """The specs of what is observed, by their keys."""
    return {key: x for key, x in base.observation_spec_unbatched.items() if key in _READ}


def _given(base: EnvBase, transforms: Compose, feed: Feed, num_envs: int) -> EnvBase:
    task = GivenTask(_specs(base), base.action_spec_unbatched, feed, num_envs, device=base.device)
    return TransformedEnv(task, transforms).append_transform(GivenEnds())
