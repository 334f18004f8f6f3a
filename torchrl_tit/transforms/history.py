"""The last K observations of an environment, under a key of their own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.utils import expand_right
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import CatFrames, Compose, Transform

from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import Padding
from torchrl_tit.settings.numbers import Size


class History(CatFrames):
    """Writes the last K observations, oldest first, and keeps the observation itself.

    TorchRL's `CatFrames` with a new axis of length K before the observation's own dimensions: an
    observation of shape ``[..., *obs]`` becomes a history of shape ``[..., K, *obs]`` and the same
    dtype, so images stay uint8 in memory. The newest observation is the last one. When an episode
    ends, ``("next", history)`` holds the terminal observation, and the next episode starts with a
    fresh history. With K = 1 nothing is stored.

    `CatFrames` alone concatenates along an existing axis, so it needs an `UnsqueezeTransform`
    before it, and its step rolls and copies the whole buffer. For small observations, this class
    writes the same in about 60% of the time. The buffers are in the environment's ``state_dict``.

    It is a transform of environments only. Of steps that are stored without histories,
    :class:`~torchrl_tit.datasets.OnlineHistoryStorage` and
    :class:`~torchrl_tit.datasets.HistoryStorage` make them.

    Args:
        num_frames: K, the number of observations in a history, at least 1.
        in_keys: keys of the observations: a list, whose entries may be nested, or one name.
        out_keys: keys of the histories, one for each of ``in_keys`` and different from all of them.
            By default the only observation has "history", in its group if it has one: ``("agents",
            "history")``. Of several, "pixels" has ``("history", "pixels")``; in nested keys,
            "history" replaces "observation".
        padding: how to pad before an episode's first step: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.

    Raises:
        ValueError: if a number or the padding is invalid, or the keys do not pair up.
        KeyError: if the environment to which it is added has no such observation.
        NotImplementedError: if it is applied to stored steps.

    Source: "Transformer in Transformer as Backbone for Deep Reinforcement Learning" (arXiv
    2212.14538), section 3: the outer transformer reads the observations of the last K steps.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), History(num_frames=4))
        >>> env.rollout(max_steps=2)["history"].shape
        torch.Size([2, 4, 4])
    """

    @checked_arguments
    def __init__(
        self,
        num_frames: Size,
        in_keys: Sequence[NestedKey] | str = ("observation",),
        out_keys: Sequence[NestedKey] | str | None = None,
        *,
        padding: Padding = "same",
    ) -> None:
        observations = _key_list(in_keys)
        histories = default_history_keys(observations) if out_keys is None else _key_list(out_keys)
        _check_keys(observations, histories)
        super().__init__(
            num_frames,
            dim=-1,  # that of each observation is in _dims
            in_keys=observations,
            out_keys=histories,
            padding=padding,
        )
        self._dims: dict[NestedKey, int] = {}  # of K in each history, in an environment
        for key in observations:  # made from the specs instead of in the first step
            delattr(self, _buffer_name(key))

    @CatFrames.reset_key.getter
    def reset_key(self) -> NestedKey:
        """Key of the mask of a reset: that of the environment, if its agents have others."""
        given = getattr(self, "_reset_key", None)
        if given is None and "_reset" in self.parent.reset_keys:
            return "_reset"
        return super().reset_key

    def set_container(self, container: Transform | EnvBase) -> None:
        """Joins an environment or a composition of transforms, and makes the buffers.

        Args:
            container: the environment or composition that the transform joins.

        Raises:
            KeyError: if the environment has no such observation.
        """
        super().set_container(container)
        if self.parent is None:  # a composition without an environment yet
            return
        specs = self.parent.full_observation_spec  # before this transform
        for key in self.in_keys:
            if key not in specs.keys(True, True):
                raise KeyError(
                    f"History found no observation {key!r} in the environment, which has "
                    f"{sorted(map(str, specs.keys(True, True)))}; name one of these in in_keys."
                )
            self._dims[key] = _history_dim(key, specs)
            if self.N > 1:
                self._make_buffer(_buffer_name(key), self._history_spec(key, specs).zero())

    def _make_buffer(self, name: str, zeros: Tensor) -> None:
        present = getattr(self, name, None)
        # A transform that joins the same environment again keeps its buffers.
        if present is None or (present.shape, present.dtype) != (zeros.shape, zeros.dtype):
            self.register_buffer(name, zeros)

    def _call(
        self, next_tensordict: TensorDictBase, _reset: Tensor | None = None
    ) -> TensorDictBase:
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            dim = self._dims.get(in_key) or _history_dim(in_key, next_tensordict)
            history = next_tensordict.get(in_key).unsqueeze(dim)  # [..., 1, *obs]
            if self.N > 1:
                name = _buffer_name(in_key)
                buffer = getattr(self, name, None)
                # No environment has made it, or one to which a transform was added since.
                if buffer is None or buffer.dtype != history.dtype:
                    zeros = torch.zeros_like(history).repeat_interleave(self.N, dim)
                    self._make_buffer(name, zeros)
                history = self._push(getattr(self, name), history, _reset, dim)
            next_tensordict.set(out_key, history)
        return next_tensordict

    def _push(self, buffer: Tensor, newest: Tensor, reset: Tensor | None, dim: int) -> Tensor:
        """Adds the newest observation to the last histories.

        Args:
            buffer: the last histories, [..., K, *obs].
            newest: [..., 1, *obs].
            reset: true where an episode begins, bool [...]; the other histories stay unchanged.
                None in a step.
            dim: that of K.

        Returns:
            The histories, [..., K, *obs].
        """
        if reset is None:
            history = torch.cat([buffer.narrow(dim, 1, self.N - 1), newest], dim)
        else:
            padding = newest if self.padding == "same" else torch.zeros_like(newest)
            first = torch.cat([*[padding] * (self.N - 1), newest], dim)
            history = torch.where(expand_right(reset, first.shape), first, buffer)
        buffer.copy_(history)
        return history

    def frames_before(self) -> dict[NestedKey, Tensor]:
        """Returns the frames before the newest one: see the function of this name."""
        buffers = {key: getattr(self, _buffer_name(key)) for key in self.in_keys if self.N > 1}
        return {key: x.narrow(self._dims[key], 0, self.N - 1).clone() for key, x in buffers.items()}

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Unlike CatFrames, the observations are never replaced by histories.
        return self._reset(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the specs of the histories.

        Args:
            observation_spec: the specs before this transform.

        Returns:
            The same specs with those of the histories.
        """
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[out_key] = self._history_spec(in_key, observation_spec)
        return observation_spec

    def _history_spec(self, key: NestedKey, specs: Composite) -> TensorSpec:
        dim = _history_dim(key, specs)
        spec = specs[key].unsqueeze(dim)
        shape = list(spec.shape)
        shape[dim] = self.N
        return spec.expand(shape).clone()

    def unfolding(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses stored steps, for which there are storages."""
        raise NotImplementedError(
            "History is a transform of environments: store steps in an OnlineHistoryStorage, which "
            "keeps each observation once and makes the histories"
        )

    make_rb_transform_and_sampler = unfolding


def observation_ndim(key: NestedKey, entries: Composite | TensorDictBase) -> int:
    """Number of an observation's own dimensions; those of its group are batch dimensions.

    Example:
        >>> from torchrl.data import Unbounded
        >>> agents = Composite(observation=Unbounded((2, 3, 84, 84)), shape=(2,))
        >>> observation_ndim(("agents", "observation"), Composite(agents=agents))
        3
    """
    group = entries if isinstance(key, str) else entries[key[:-1]]
    return entries[key].ndim - group.ndim


def default_history_keys(observations: Sequence[NestedKey]) -> list[NestedKey]:
    """Names the histories of observations: see ``out_keys`` of :class:`History`.

    Example:
        >>> default_history_keys(["pixels"]), default_history_keys([("agents", "observation")])
        (['history'], [('agents', 'history')])
        >>> default_history_keys(["pixels", ("arm", "left"), ("observation", "state")])
        [('history', 'pixels'), ('history', 'arm/left'), ('history', 'state')]
    """
    histories: list[NestedKey] = []
    for key in observations:
        *groups, name = parts = (key,) if isinstance(key, str) else key
        alone = len(observations) == 1
        if groups[:1] == ["observation"]:
            parts = ("history", *parts[1:])
        elif "observation" in name and (alone or groups):
            parts = (*groups, name.replace("observation", "history"))
        else:
            parts = (*groups, "history") if alone else ("history", "/".join(parts))
        histories.append(unravel_key(parts))
    return histories


def frames_before(env: EnvBase) -> dict[NestedKey, Tensor]:
    """Returns the frames that precede the newest one of an environment, from each `History` in it.

    So a batch of consecutive steps needs no histories: read them before the first step.

    Args:
        env: an environment with transforms.

    Returns:
        Copies of the K - 1 frames before the newest, oldest first, [..., K - 1, *obs], under the
        key of the observation; of a History with K = 1, none.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), History(num_frames=4))
        >>> first = env.reset()["history"]
        >>> torch.equal(frames_before(env)["observation"], first[:-1])
        True
    """
    frames: dict[NestedKey, Tensor] = {}
    for history in _histories_of(env):
        frames |= history.frames_before()
    return frames


def keys_of_histories(env: EnvBase) -> dict[NestedKey, NestedKey]:
    """Returns the key of the observation of each history that a `History` of an environment writes.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> keys_of_histories(TransformedEnv(GymEnv("CartPole-v1"), History(num_frames=4)))
        {'history': 'observation'}
    """
    return {
        out_key: in_key
        for history in _histories_of(env)
        for in_key, out_key in zip(history.in_keys, history.out_keys, strict=True)
    }


def _histories_of(env: EnvBase) -> Iterator[History]:
    while isinstance(env, TransformedEnv):
        transforms = env.transform if isinstance(env.transform, Compose) else [env.transform]
        yield from (transform for transform in transforms if isinstance(transform, History))
        env = env.base_env


def _buffer_name(key: NestedKey) -> str:
    """The name that `CatFrames` gives the buffer of a key."""
    return f"_cat_buffers_{key}"


def _history_dim(key: NestedKey, entries: Composite | TensorDictBase) -> int:
    """The dimension of K in the history of an observation, counted from the last."""
    return -1 - observation_ndim(key, entries)


def _key_list(keys: Sequence[NestedKey] | str) -> list[NestedKey]:
    return [unravel_key(key) for key in ([keys] if isinstance(keys, str) else keys)]


def _check_keys(in_keys: list[NestedKey], out_keys: list[NestedKey]) -> None:
    if not in_keys or len(in_keys) != len(out_keys):
        raise ValueError(
            f"History needs one key in out_keys for each in in_keys, and at least one, but has "
            f"in_keys={in_keys} and out_keys={out_keys}."
        )
    if len({*in_keys, *out_keys}) != len(in_keys) + len(out_keys):
        raise ValueError(
            f"A history needs a key of its own, but in_keys={in_keys} and out_keys={out_keys} "
            f"name one twice; choose others."
        )
