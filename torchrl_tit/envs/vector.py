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

from torchrl_tit.transforms.history import Padding, check_history


class GymVectorEnv(EnvBase):
    """N copies of a Gymnasium task, with history and return, as one TorchRL environment.

    It writes what TorchRL's `GymWrapper` under the transforms `DoubleToFloat`,
    :class:`~torchrl_tit.transforms.History` and `RewardSum` writes, several times as fast: for
    small tasks the time of a step goes into the bookkeeping around it, and here one class does in a
    few lines what the general machinery does in many calls. Further transforms can go on top.

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``observation``         [N, *obs]           float32, or the task's own integers (images: uint8)
    ``history``             [N, K, *obs]        the last K observations, the newest last
    ``episode_reward``      [N, 1]              float32, the undiscounted return so far
    ``action``              [N] or [N, A]       int64 for discrete actions, else float32
    ``reward``              [N, 1]              float32
    ``terminated``          [N, 1]              bool, the task ended the episode
    ``truncated``           [N, 1]              bool, the time limit did
    ``done``                [N, 1]              bool, either
    ======================  ==================  ===================================================

    Continuous actions are clipped to the task's bounds on their way to the task only: the
    tensordict keeps what the policy sampled, which is what its log-probability belongs to.

    History and return are buffers, so `state_dict` holds them; the tasks' own state is not in it.

    Args:
        env: The vector environment, made with ``autoreset_mode=AutoresetMode.DISABLED``, with
            array or image observations and discrete or continuous actions.
        history: K, the number of observations in a history.
        padding: What stands for the steps before an episode's first: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        clip_actions: Whether continuous actions are clipped and their spec is unbounded. If not,
            they are sent as they are, and the spec has the task's bounds.
        device: Where the tensors go; by default they stay on the CPU without a stated device.

    Raises:
        TypeError: If the observations or actions are of another kind.
        ValueError: If the vector environment resets by itself, or history or padding are wrong.

    Example:
        >>> from gymnasium.vector import SyncVectorEnv
        >>> tasks = [lambda: gymnasium.make("CartPole-v1")] * 8
        >>> env = GymVectorEnv(SyncVectorEnv(tasks, autoreset_mode="Disabled"), history=4)
        >>> env.rollout(max_steps=2)["next", "history"].shape
        torch.Size([8, 2, 4, 4])
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv,
        *,
        history: int = 1,
        padding: Padding = "same",
        clip_actions: bool = True,
        device: torch.device | str | None = None,
    ) -> None:
        check_history(history, padding)
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
        self._padding = padding
        self._observation_dtype = np.dtype("f4") if space.dtype.kind == "f" else space.dtype
        action = env.single_action_space
        self._bounds = (
            (action.low, action.high) if isinstance(action, Box) and clip_actions else None
        )

        n = env.num_envs
        example = self._tensor(np.zeros((n, 1, *space.shape), self._observation_dtype))
        self.register_buffer("_history", example.repeat_interleave(history, 1))  # [N, K, *obs]
        self.register_buffer("_return", torch.zeros(n, 1, device=self.device))
        observation = {
            "observation": _unbounded(example.squeeze(1)),
            "history": _unbounded(self._history),
            "episode_reward": _unbounded(self._return),
        }
        flag = Categorical(2, shape=(n, 1), dtype=torch.bool, device=self.device)
        flags = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.observation_spec = Composite(observation, shape=(n,), device=self.device)
        self.action_spec = _action_spec(action, n, clip_actions, self.device)
        self.reward_spec = _unbounded(self._return)
        self.done_spec = Composite(flags, shape=(n,), device=self.device)

    @property
    def base_env(self) -> "GymVectorEnv":
        """Itself: what `TransformedEnv.base_env` is once transforms are on top."""
        return self

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps all environments and resets those whose episode ended.

        The same as TorchRL's, less the checks of what this class is sure to write. A tensordict
        that asks for more (entries under "next", another device) takes TorchRL's own way.

        Args:
            tensordict: Holds the action; [N].

        Returns:
            The tensordict with its "next", and the one to act on next.
        """
        keys = tensordict.keys()
        if "next" in keys or "_step" in keys or tensordict.device != self.device:
            return super().step_and_maybe_reset(tensordict)
        outcome = self._step(tensordict)
        tensordict.set("next", outcome)
        return tensordict, self.maybe_reset(self._step_mdp(tensordict))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        stepped = tensordict.get("_step", None)
        if stepped is not None and not stepped.all():
            raise NotImplementedError("GymVectorEnv cannot step only some of its environments.")
        action = tensordict["action"].numpy(force=True)
        if self._bounds is not None:
            action = action.clip(*self._bounds)
        observations, rewards, terminated, truncated, info = self._env.step(action)
        observation = self._tensor(np.array(observations, self._observation_dtype))
        reward = self._tensor(rewards.astype(np.float32)).unsqueeze(-1)
        self._return.add_(reward)
        return self._tensordict(
            observation=observation,
            history=self._push(observation),
            episode_reward=self._return.clone(),
            reward=reward,
            terminated=self._tensor(terminated).unsqueeze(-1),
            truncated=self._tensor(truncated).unsqueeze(-1),
            done=self._tensor(terminated | truncated).unsqueeze(-1),
            **self._further(info),
        )

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        return self._restart(None if mask is None else mask.reshape(self.batch_size), seed)

    def _restart(self, mask: Tensor | None = None, seed: int | None = None) -> TensorDictBase:
        """Begins new episodes where the mask [N] is set, or all; the others' entries are kept."""
        options = None if mask is None else {"reset_mask": mask.numpy(force=True)}
        observations, info = self._env.reset(seed=seed, options=options)
        observation = self._tensor(np.array(observations, self._observation_dtype))
        where = slice(None) if mask is None else mask
        first = observation[where].unsqueeze(1)  # [M, 1, *obs]
        self._history[where] = first if self._padding == "same" else torch.zeros_like(first)
        self._history[where, -1:] = first
        self._return[where] = 0
        flag = torch.zeros_like(self._return, dtype=torch.bool)
        return self._tensordict(
            observation=observation,
            history=self._history.clone(),
            episode_reward=self._return.clone(),
            terminated=flag,
            truncated=flag.clone(),
            done=flag.clone(),
            **self._further(info),
        )

    def _further(self, info: dict[str, Any]) -> dict[str, Tensor]:
        """What else a subclass writes, from what the vector environment tells beside."""
        return {}

    @property
    def render_fps(self) -> int:
        """Pictures a second at which the task looks natural."""
        return int(self._env.metadata.get("render_fps", 30))

    def render(self) -> np.ndarray:
        """Takes pictures of the tasks, which must be made with ``render_mode="rgb_array"``.

        Returns:
            One picture of each task; uint8 [N, height, width, 3].

        Raises:
            ValueError: If the tasks have no pictures.
        """
        pictures = self._env.render() or (None,)
        if pictures[0] is None:
            raise ValueError('The tasks have no pictures; make them with render_mode="rgb_array".')
        return np.stack(pictures)

    def _set_seed(self, seed: int | None) -> None:
        # As in GymWrapper: a reset seeds environment i with seed + i, and it draws on from there.
        self._env.reset(seed=seed)

    def _push(self, observation: Tensor) -> Tensor:
        """The histories [N, K, *obs] with one more observation [N, *obs]."""
        history = observation.unsqueeze(1)
        if self._history.shape[1] > 1:
            history = torch.cat((self._history[:, 1:], history), 1)
        self._history.copy_(history)
        return history

    def _tensor(self, array: np.ndarray) -> Tensor:
        tensor = torch.from_numpy(array)
        return tensor if self.device is None else tensor.to(self.device)

    def _tensordict(self, **entries: Tensor) -> TensorDict:
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the tasks.

        Args:
            raise_if_closed: As in TorchRL; closing twice is fine here.
        """
        self._env.close()
        super().close(raise_if_closed=raise_if_closed)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._env}, batch_size={list(self.batch_size)})"


def _unbounded(tensor: Tensor) -> TensorSpec:
    return Unbounded(tensor.shape, device=tensor.device, dtype=tensor.dtype)


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
