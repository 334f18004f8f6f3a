"""Tasks without a simulator: what is observed comes from outside, whatever the action."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from torchrl_tit.envs.actions import ActionWriter
from torchrl_tit.envs.spaces import array_spec, end_flags
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Size

Feed = Callable[[bool], Mapping[str, Any]]


class GivenTask(EnvBase):
    """Copies of a task whose observations a function gives: a machine's, or those of recorded data.

    Its actions have no effect. It has the keys of :class:`~torchrl_tit.envs.GymVectorEnv`, so that
    transforms and policies work as in the task itself.

    Args:
        observation_spec: specs of the observation and of further entries, such as "action_mask",
            by their keys, without batch dimensions.
        action_spec: spec of an action, without batch dimensions.
        feed: called at each step and each reset, with whether episodes begin; returns the entries
            of ``observation_spec``, [N, ...] each, and after a step possibly "reward" float [N, 1]
            and "truncated" bool [N, 1], which are zeros by default.
        num_envs: number N of copies.
        action_writer: what converts actions to those of the task, if it is known.
        device: device of the tensors.

    Example:
        >>> frames = iter(torch.arange(3.0).view(3, 1, 1))
        >>> specs = {"observation": Unbounded(1)}
        >>> env = GivenTask(specs, Unbounded(2), lambda begins: {"observation": next(frames)})
        >>> env.rollout(2)["next", "observation"].flatten()
        tensor([1., 2.])
    """

    render_fps = 30

    def __init__(
        self,
        observation_spec: Mapping[str, TensorSpec],
        action_spec: TensorSpec,
        feed: Feed,
        num_envs: int = 1,
        *,
        action_writer: ActionWriter | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.feed, self.action_writer = feed, action_writer
        self.observation_spec = self._copies(Composite(dict(observation_spec)))
        self.action_spec = self._copies(action_spec)
        self.reward_spec = self._copies(Unbounded((1,), dtype=torch.float32))
        self.done_spec = self._copies(end_flags())

    def _copies(self, spec: TensorSpec) -> TensorSpec:
        spec = spec.expand(*self.batch_size, *spec.shape).clone()
        return spec if self.device is None else spec.to(self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._given(True)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._given(False)

    def _given(self, begins: bool) -> TensorDict:
        given, zeros = dict(self.feed(begins)), torch.zeros(*self.batch_size, 1)
        truncated = zeros.bool() if begins else given.get("truncated", zeros.bool())
        self.ends = {"truncated": truncated, "terminated": zeros.bool(), "done": truncated.clone()}
        entries = given | self.ends | ({} if begins else {"reward": given.get("reward", zeros)})
        return TensorDict(entries, self.batch_size, device=self.device)

    def render(self) -> np.ndarray:
        """Renders the newest observations as ``feed.render()`` does; uint8 [N, height, width, 3].

        Raises:
            ValueError: if the feed has no such method.
        """
        if not hasattr(self.feed, "render"):
            raise ValueError("there is no environment that could be rendered")
        return self.feed.render()

    def _set_seed(self, seed: int | None) -> None:
        pass


class GivenEnds(Transform):
    """Ends episodes of a :class:`GivenTask` where its feed does: time limits of the task do not."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        assert self.parent is not None
        return next_tensordict.update(self.parent.base_env.ends)


@checked_arguments
def make_unknown_task(
    num_envs: int = 1,
    *,
    observation_shape: Sequence[int],
    observation_dtype: Literal["float32", "uint8"] = "float32",
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    num_actions: Size | None = None,
    clip_actions: bool = True,
    device: torch.device | str | None = None,
) -> GivenTask:
    """Makes copies of a task of which only the observations and actions are known.

    :func:`~torchrl_tit.envs.make_env` calls it for a task without a name. Observations are random,
    and episodes do not end.

    Args:
        num_envs: number of copies.
        observation_shape: shape of an observation: [D], or an image [H, W] or [C, H, W].
        observation_dtype: its dtype.
        low: lowest values of a continuous action, [A].
        high: highest values, [A].
        num_actions: number of actions, if they are discrete instead.
        clip_actions: whether actions are clipped to their bounds.
        device: device of the tensors.

    Raises:
        ValueError: if the spaces are incomplete or invalid.

    Example:
        >>> env = make_unknown_task(2, observation_shape=[12], low=[-1, 0], high=[1, 5])
        >>> env.rollout(3)["action"].shape
        torch.Size([2, 3, 2])
    """
    action_space: Space
    if num_actions is not None:
        action_space = Discrete(num_actions)
    else:
        lowest, highest = (np.atleast_1d(np.array(x, np.float32)) for x in (low, high))
        if (
            lowest.shape != highest.shape
            or lowest.ndim != 1
            or not (np.isfinite([lowest, highest]).all() and (lowest < highest).all())
        ):
            raise ValueError(
                f"actions need num_actions, or low below high for each entry, not low={low} and "
                f"high={high}"
            )
        action_space = Box(lowest, highest)
    writer = ActionWriter(action_space, clip=clip_actions)
    dtype = getattr(torch, observation_dtype)
    spec, _ = array_spec("observation", tuple(observation_shape), dtype, "CHW")
    return GivenTask(
        {"observation": spec},
        writer.spec,
        lambda begins: {"observation": spec.rand(torch.Size([num_envs]))},
        num_envs,
        action_writer=writer,
        device=device,
    )
