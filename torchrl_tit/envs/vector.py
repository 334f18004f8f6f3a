"""A Gymnasium vector environment as a TorchRL environment that adds little time to a step."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase


class GymVectorEnv(EnvBase):
    """N copies of a Gymnasium task as one TorchRL environment.

    It writes what TorchRL's `GymWrapper` under the transform `DoubleToFloat` writes, several times
    as fast: a step of a small task costs less than the bookkeeping around it, which is a few lines
    here. Histories, returns and the like are transforms on top: see
    :func:`~torchrl_tit.envs.make_env`.

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``observation``         [N, *obs]           float32, or the task's own integers (images: uint8)
    ``action``              [N] or [N, A]       int64 for discrete actions, else float32
    ``reward``              [N, 1]              float32
    ``terminated``          [N, 1]              bool, the task ended the episode
    ``truncated``           [N, 1]              bool, the time limit ended the episode
    ``done``                [N, 1]              bool, either
    ======================  ==================  ===================================================

    Continuous actions are clipped to the task's bounds only on their way to the task: the
    tensordict keeps the sampled action, which its log-probability belongs to.

    Args:
        env: The vector environment, made with ``autoreset_mode=AutoresetMode.DISABLED``, with
            array or image observations and discrete or continuous actions.
        clip_actions: Whether continuous actions are clipped and their spec is unbounded. Otherwise
            they are passed on unchanged, and the spec has the task's bounds.
        device: Device of the tensors; by default they stay on the CPU and the device is None.

    Raises:
        TypeError: If the observations or actions are of another kind.
        ValueError: If the vector environment resets itself.

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
        device: torch.device | str | None = None,
    ) -> None:
        if env.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED:
            raise ValueError(
                "TorchRL resets environments itself; make the vector environment with "
                f"autoreset_mode=AutoresetMode.DISABLED, not {env.metadata.get('autoreset_mode')}."
            )
        space = env.single_observation_space
        if not isinstance(space, Box):
            raise TypeError(
                f"Observations must be a Box, but are {space}; use TorchRL's GymWrapper."
            )
        super().__init__(device=device, batch_size=torch.Size([env.num_envs]))
        self._env = env
        self.is_closed = False
        self._observation_dtype = np.dtype("f4") if space.dtype.kind == "f" else space.dtype
        action = env.single_action_space
        self._bounds = (
            (action.low, action.high) if isinstance(action, Box) and clip_actions else None
        )

        n = env.num_envs
        example = torch.from_numpy(np.zeros((n, *space.shape), self._observation_dtype))
        observation = Unbounded(example.shape, dtype=example.dtype, device=self.device)
        flag = Categorical(2, shape=(n, 1), dtype=torch.bool, device=self.device)
        flags = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.observation_spec = Composite(observation=observation, shape=(n,), device=self.device)
        self.action_spec = _action_spec(action, n, clip_actions, self.device)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32, device=self.device)
        self.done_spec = Composite(flags, shape=(n,), device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        stepped = tensordict.get("_step", None)
        if stepped is not None and not stepped.all():
            raise NotImplementedError("GymVectorEnv cannot step only some of its environments.")
        action = tensordict["action"].numpy(force=True)
        if self._bounds is not None:
            action = action.clip(*self._bounds)
        observations, rewards, terminated, truncated, info = self._env.step(action)
        return self._tensordict(
            observation=self._tensor(np.array(observations, self._observation_dtype)),
            reward=self._tensor(rewards.astype(np.float32)).unsqueeze(-1),
            terminated=self._tensor(terminated).unsqueeze(-1),
            truncated=self._tensor(truncated).unsqueeze(-1),
            done=self._tensor(terminated | truncated).unsqueeze(-1),
            **self._further(info),
        )

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        options = None if mask is None else {"reset_mask": mask.flatten().numpy(force=True)}
        observations, info = self._env.reset(seed=seed, options=options)
        flag = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return self._tensordict(
            observation=self._tensor(np.array(observations, self._observation_dtype)),
            terminated=flag,
            truncated=flag.clone(),
            done=flag.clone(),
            **self._further(info),
        )

    def _further(self, info: dict[str, Any]) -> dict[str, Tensor]:
        """Further entries of a subclass, from the vector environment's info."""
        return {}

    @property
    def render_fps(self) -> int:
        """The task's frames per second."""
        return int(self._env.metadata.get("render_fps", 30))

    def render(self) -> np.ndarray:
        """Renders the tasks, which must be made with ``render_mode="rgb_array"``.

        Returns:
            One image of each task; uint8 [N, height, width, 3].

        Raises:
            ValueError: If the tasks cannot be rendered.
        """
        pictures = self._env.render() or (None,)
        if pictures[0] is None:
            raise ValueError('The tasks have no pictures; make them with render_mode="rgb_array".')
        return np.stack(pictures)

    def _set_seed(self, seed: int | None) -> None:
        # As in GymWrapper: this reset seeds copy i with seed + i; later resets draw from there.
        self._env.reset(seed=seed)

    def _tensor(self, array: np.ndarray) -> Tensor:
        tensor = torch.from_numpy(array)
        return tensor if self.device is None else tensor.to(self.device)

    def _tensordict(self, **entries: Tensor) -> TensorDict:
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the tasks.

        Args:
            raise_if_closed: As in TorchRL, but closing twice is allowed.
        """
        self._env.close()
        super().close(raise_if_closed=raise_if_closed)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._env}, batch_size={list(self.batch_size)})"


def _action_spec(
    space: gymnasium.Space, n: int, clip: bool, device: torch.device | None
) -> TensorSpec:
    if isinstance(space, Discrete) and space.start == 0:
        return Categorical(int(space.n), shape=(n,), dtype=torch.int64, device=device)
    if isinstance(space, Box):
        shape = (n, *space.shape)
        if clip:
            return Unbounded(shape, dtype=torch.float32, device=device)
        low, high = (torch.as_tensor(x).expand(shape) for x in (space.low, space.high))
        return Bounded(low, high, shape, dtype=torch.float32, device=device)
    raise TypeError(
        f"Actions must be Discrete from 0 or a Box, but are {space}; use TorchRL's GymWrapper."
    )
