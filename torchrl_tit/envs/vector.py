"""A Gymnasium vector environment as a TorchRL environment with little overhead per step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_tit.envs.action_masks import MASK, ActionMasks, check_allowed
from torchrl_tit.envs.actions import ActionWriter, refuse_nan
from torchrl_tit.envs.spaces import ObservationReader, end_flags
from torchrl_tit.settings.choices import ImageLayout


class GymVectorEnv(EnvBase):
    """N copies of a Gymnasium task as one TorchRL environment.

    It writes the same entries as TorchRL's `GymWrapper` with the transform `DoubleToFloat`, several
    times faster: a step of a small task costs less than the bookkeeping around it, which is kept
    minimal here. Histories, returns and the like are written by transforms: see
    :func:`~torchrl_tit.envs.make_env`.

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``observation``         [N, *obs]           or nested, if there are several: their kinds are
                                                those of :func:`~torchrl_tit.envs.observation_specs`
    ``action``              [N] or [N, A]       int64, int8 (MultiBinary) or float32 (Box)
    ``action_mask``         [N, n]              bool, what is allowed, with ``mask_actions``
    ``reward``              [N, 1]              float32
    ``terminated``          [N, 1]              bool, the task ended the episode
    ``truncated``           [N, 1]              bool, the time limit ended the episode
    ``done``                [N, 1]              bool, either
    ======================  ==================  ===================================================

    Several observations (Dict, Tuple) are nested: ``("observation", NAME)``, where the name of an
    observation in a nested Dict joins the keys with "/" (and dots in them become "_"), and those
    of a Tuple are "0", "1", ...
    Images are written with their channels first. Text and other unsupported observations are left
    out with a warning if there are supported ones.

    Continuous actions are clipped to the task's bounds only when they are passed to the task: the
    tensordict keeps the sampled action, to which its log-probability belongs. A step raises
    ValueError if an action is NaN.

    Args:
        env: the vector environment, made with ``autoreset_mode=AutoresetMode.DISABLED``. Its
            observations can be Box, Discrete, MultiDiscrete and MultiBinary, and Dict and Tuple of
            these, its actions Box, Discrete, MultiDiscrete and MultiBinary.
        clip_actions: whether continuous actions are clipped and their spec is unbounded. Otherwise
            they are passed on unchanged, and the spec has the task's bounds, as the nearest float32
            within them. Integers (a Box of them) are rounded and clipped in either case.
        observation_keys: names of the observations to keep; all by default.
        image_layout: where images have their channels: ``"HWC"``, ``"CHW"``, or ``"auto"``, which
            infers it from their shape.
        mask_actions: whether to write which actions are allowed: the task's observation
            "action_mask" (then not written as an observation), or the entry of that name in its
            ``info``.
        device: device of the tensors; by default they stay on the CPU and the device is None.

    Raises:
        ValueError: if the vector environment resets itself, observations or actions are of another
            kind, there is no observation of that name, the layout of an image cannot be inferred,
            or the task has no action mask.

    Example:
        >>> from gymnasium.vector import SyncVectorEnv
        >>> tasks = [lambda: gymnasium.make("CartPole-v1")] * 8
        >>> env = GymVectorEnv(SyncVectorEnv(tasks, autoreset_mode="Disabled"))
        >>> env.rollout(max_steps=2)["next", "observation"].shape
        torch.Size([8, 2, 4])
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv,
        *,
        clip_actions: bool = True,
        observation_keys: Sequence[str] = (),
        image_layout: ImageLayout = "auto",
        mask_actions: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        if env.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED:
            raise ValueError(
                "TorchRL resets environments itself; make the vector environment with "
                f"autoreset_mode=AutoresetMode.DISABLED, not {env.metadata.get('autoreset_mode')}."
            )
        read = ObservationReader(
            env.single_observation_space,
            keys=observation_keys,
            image_layout=image_layout,
            mask_actions=mask_actions,
        )
        write = ActionWriter(env.single_action_space, clip=clip_actions)
        n = env.num_envs
        masks = ActionMasks(n, env.single_action_space) if mask_actions else None
        super().__init__(device=device, batch_size=torch.Size([n]))
        self._env, self._read, self._write, self._masks = env, read, write, masks
        self.is_closed = False
        if masks is not None:
            self._check_masks()

        entries = {"observation": read.spec.expand(n, *read.spec.shape)}
        if masks is not None:
            entries[MASK] = Binary(masks.shape[-1], shape=masks.shape, dtype=torch.bool)
        observation = Composite(entries, shape=(n,)).clone()
        action = write.spec.expand(n, *write.spec.shape).clone()
        self.observation_spec = observation if device is None else observation.to(device)
        self.action_spec = action if device is None else action.to(device)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32, device=self.device)
        self.done_spec = end_flags(n) if device is None else end_flags(n).to(device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        stepped = tensordict.get("_step", None)
        if stepped is not None and not stepped.all():
            raise NotImplementedError("GymVectorEnv cannot step only some of its environments.")
        action = tensordict["action"].detach().cpu()
        if action.is_floating_point():
            refuse_nan(action)
        try:
            stepped = self._env.step(self._write(action).numpy())
        except ValueError as error:
            if "array element with a sequence" in str(error):  # Gymnasium's message names nothing
                raise ValueError("A task returns an array as its reward: return a float.") from None
            raise
        observations, rewards, terminated, truncated, info = stepped
        return self._tensordict(
            **self._observed(observations, info, terminated | truncated),
            reward=self._tensor(rewards.astype(np.float32)).unsqueeze(-1),
            terminated=self._tensor(terminated).unsqueeze(-1),
            truncated=self._tensor(truncated).unsqueeze(-1),
            done=self._tensor(terminated | truncated).unsqueeze(-1),
            **self._further(info),
        )

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | Sequence[int] | None = None
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        reset = np.ones(self.batch_size, bool) if mask is None else mask.flatten().numpy(force=True)
        options = None if mask is None else {"reset_mask": reset}
        self._seed_spaces(seed)
        try:
            # Gymnasium's vector environments take sequences too; their base class does not say so.
            observations, info = self._env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        except ValueError:
            self._check_shapes()
            raise
        flag = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return self._tensordict(
            **self._observed(observations, info, ~reset),
            terminated=flag,
            truncated=flag.clone(),
            done=flag.clone(),
            **self._further(info),
        )

    def _observed(
        self, observations: Any, info: dict[str, Any], ended: np.ndarray
    ) -> dict[str, Any]:
        """The observation, or several in a tensordict, and the action mask."""
        values = self._read(observations)
        if not isinstance(values, dict):
            entries = {"observation": self._tensor(values)}
        else:
            parts = {name: self._tensor(value) for name, value in values.items()}
            entries = {"observation": self._tensordict(**parts)}
        if self._masks is not None:
            observed = self._read.masks(observations)
            masks = self._masks
            found = masks.from_observations(observed) if observed else masks.from_info(info)
            check_allowed(found, ended, masks.sizes)
            entries[MASK] = self._tensor(found)
        return entries

    def _check_shapes(self) -> None:
        """Raises ValueError if observations do not have the shape of their space."""
        for env in getattr(self._env, "envs", ()):  # missing for tasks in other processes
            observation, _ = env.reset()
            shape, declared = np.shape(observation), env.observation_space.shape
            if declared is not None and shape != declared:
                raise ValueError(
                    f"The task {env} returns observations of shape {shape}, but its space says "
                    f"{declared}: correct the task, or the order of its wrappers."
                )

    def _check_masks(self) -> None:
        """Raises ValueError if the task has no action masks."""
        observations, info = self._env.reset()
        if not self._read.masks(observations) and MASK not in info:
            raise ValueError(
                f'The task has no mask of its actions, neither an observation "{MASK}" nor one in '
                "its info: leave out mask_actions."
            )
        self._observed(observations, info, np.zeros(self.batch_size, bool))

    def _further(self, info: dict[str, Any]) -> dict[str, Tensor]:
        """Further entries of a subclass, from the vector environment's info."""
        return {}

    @property
    def action_writer(self) -> ActionWriter:
        """The object that converts the tensordict's actions to those of the tasks."""
        return self._write

    @property
    def render_fps(self) -> int:
        """The task's frames per second."""
        return int(self._env.metadata.get("render_fps", 30))

    def render(self) -> np.ndarray:
        """Renders the tasks, which must be made with ``render_mode="rgb_array"``.

        Returns:
            One image per task; uint8 [N, height, width, 3].

        Raises:
            ValueError: if the tasks cannot be rendered.
        """
        pictures = self._env.render() or (None,)
        if pictures[0] is None:
            raise ValueError('The tasks have no pictures; make them with render_mode="rgb_array".')
        return np.stack(pictures)

    def _set_seed(self, seed: int | None) -> None:
        # As in GymWrapper: this reset seeds copy i with seed + i; later resets draw from there.
        self._seed_spaces(seed)
        self._env.reset(seed=seed)

    def _seed_spaces(self, seed: int | Sequence[int] | None) -> None:
        """Seeds the spaces, which resets do not; those in other processes are unchanged."""
        if seed is None:
            return
        seeds = range(seed, seed + self._env.num_envs) if isinstance(seed, int) else seed
        copies = getattr(self._env.unwrapped, "envs", ())
        for own, layer in zip([seeds[0], *seeds], [self._env, *copies], strict=False):
            while True:
                for space in (layer.action_space, layer.observation_space):
                    space.seed(own)
                if not isinstance(layer, gymnasium.Wrapper | gymnasium.vector.VectorWrapper):
                    break
                layer = layer.env

    def _tensor(self, array: np.ndarray) -> Tensor:
        tensor = torch.from_numpy(array)
        return tensor if self.device is None else tensor.to(self.device)

    def _tensordict(self, **entries: Tensor) -> TensorDict:
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the tasks.

        Args:
            raise_if_closed: as in TorchRL, but closing twice is allowed.
        """
        self._env.close()
        super().close(raise_if_closed=raise_if_closed)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._env}, batch_size={list(self.batch_size)})"
