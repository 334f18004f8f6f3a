"""The last K observations of an environment, under a key of their own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any

import torch
from msgspec import Meta
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.utils import expand_right
from torch import Tensor
from torchrl.data import Composite, SliceSampler, TensorSpec
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import CatFrames, Compose, ExcludeTransform, Transform

from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import Padding
from torchrl_tit.settings.numbers import Size
from torchrl_tit.windows import Windows, differs, find_windows


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

    As a transform of a replay buffer it makes the histories of sampled slices, see
    :meth:`unfolding` and :meth:`make_rb_transform_and_sampler`.

    Args:
        num_frames: K, the number of observations in a history, at least 1.
        in_keys: keys of the observations: a list, whose entries may be nested, or one name. On
            stored data, the histories of the next observations are made in any case; they can be
            named as `CatFrames` requires, ``["observation", ("next", "observation")]``.
        out_keys: keys of the histories, one for each of ``in_keys`` and different from all of them.
            By default the only observation has "history", in its group if it has one: ``("agents",
            "history")``. Of several, "pixels" has ``("history", "pixels")``; in nested keys,
            "history" replaces "observation".
        observation_ndim: number of dimensions of one observation, for a check: 1 for arrays [D], 2
            for gray images [H, W], 3 for images [C, H, W]. By default each observation has those
            that the batch of its group, such as [*B, agents], does not have.
        padding: how to pad before an episode's first step: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.

    Raises:
        TypeError: if ``in_keys`` or ``out_keys`` are no keys.
        ValueError: if a number or the padding is invalid, the keys do not pair up, a key under
            "next" is not that of an observation in ``in_keys``, or, when the transform is added to
            an environment, its observation does not have ``observation_ndim`` dimensions, if given.
        KeyError: if the environment has no such observation.

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
        observation_ndim: Annotated[int, Meta(ge=0)] | None = None,
        padding: Padding = "same",
    ) -> None:
        observations = _key_list("in_keys", in_keys)
        if out_keys is None:
            observations = [key for key in observations if key[0] != "next"]
            histories = default_history_keys(observations)
        else:
            histories = _key_list("out_keys", out_keys)
        _check_keys(observations, histories)
        observations, histories = _without_next(observations, histories)
        super().__init__(
            num_frames,
            dim=-1,  # that of each observation is in _dims
            in_keys=observations,
            out_keys=histories,
            padding=padding,
        )
        self._observation_ndim = observation_ndim
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
            ValueError: if an observation does not have ``observation_ndim`` dimensions, if given.
        """
        super().set_container(container)
        if self.parent is None:  # a composition without an environment yet
            return
        specs = self.parent.full_observation_spec  # before this transform
        for key in self.in_keys:
            self._check_observation(key, specs)
            self._dims[key] = self._dim(key, specs)
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
            dim = self._dims.get(in_key) or self._dim(in_key, next_tensordict)
            history = next_tensordict.get(in_key).unsqueeze(dim)  # [..., 1, *obs]
            if self.N > 1:
                name = _buffer_name(in_key)
                buffer = getattr(self, name, None)
                # No environment has made it, one to which a transform was added since, or one that
                # takes any batch size and begins with another.
                if (
                    buffer is None
                    or buffer.dtype != history.dtype
                    or (_reset is not None and buffer.shape[:dim] != history.shape[:dim])
                ):
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
        dim = self._dim(key, specs)
        spec = specs[key].unsqueeze(dim)
        shape = list(spec.shape)
        shape[dim] = self.N
        return spec.expand(shape).clone()

    def _dim(self, key: NestedKey, entries: Composite | TensorDictBase) -> int:
        """The dimension of K in the history of an observation, counted from the last."""
        ndim = self._observation_ndim
        return -1 - (observation_ndim(key, entries) if ndim is None else ndim)

    def unfolding(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Makes the histories of stored steps, and of the next steps if these are stored.

        A history begins at the latest where its slice does: at t = 0, at "is_init", after a done
        step, and where an observation differs from the previous step's next observation. Frames
        before a slice are unknown and replaced by padding.

        Args:
            tensordict: [..., T]; the last dimension, or the one named "time", is time.

        Returns:
            The same tensordict with the histories [..., T, K, *obs].

        Raises:
            ValueError: if the steps are not slices, or the starts of slices cannot be found.
        """
        time = tensordict.ndim - 1
        named = [axis for axis, name in enumerate(tensordict.names) if name == "time"]
        if named and named[0] != time:
            made = self.unfolding(tensordict.transpose(named[0], time))
            return tensordict.update(made.transpose(named[0], time))
        windows = find_histories(tensordict, self.in_keys, self.N, self.padding)
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            frames = tensordict.get(in_key).flatten(0, time)
            dim = self._dim(in_key, tensordict)
            history = windows.gather(frames).movedim(time + 1, dim)
            tensordict.set(out_key, history)
            following = tensordict.get(unravel_key(("next", in_key)), None)
            if following is not None:
                kept = history.narrow(dim, 1, self.N - 1)
                moved = torch.cat([kept, following.unsqueeze(dim)], dim)
                tensordict.set(unravel_key(("next", out_key)), moved)
        return tensordict

    def make_rb_transform_and_sampler(
        self, batch_size: int, **sampler_kwargs: Any
    ) -> tuple[Transform, SliceSampler]:
        """Builds the transform and sampler to store each observation once and sample histories.

        Like `CatFrames.make_rb_transform_and_sampler`, leaves out histories, also those under
        "next", when steps are stored. To sample a step, the K - 1 steps before it are also read. So
        an episode's first K - 1 steps are never drawn;
        :class:`~torchrl_tit.datasets.OnlineHistoryStorage` draws every step and reads less.

        Args:
            batch_size: ignored; the buffer's batch size is used.
            **sampler_kwargs: passed to `SliceSampler`, which finds the episodes.

        Returns:
            The transform and the sampler.

        Raises:
            ValueError: if slices may be shorter than K steps.

        Example:
            >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
            >>> from torchrl.envs import GymEnv, TransformedEnv
            >>> env = TransformedEnv(GymEnv("CartPole-v1"), History(num_frames=4))
            >>> transform, sampler = History(4).make_rb_transform_and_sampler(
            ...     batch_size=8, end_key=("next", "done"), truncated_key=None
            ... )
            >>> storage = LazyTensorStorage(100)
            >>> buffer = ReplayBuffer(
            ...     storage=storage, sampler=sampler, transform=transform, batch_size=8
            ... )
            >>> _ = buffer.extend(env.rollout(50, break_when_any_done=False))
            >>> buffer.sample()["next", "history"].shape
            torch.Size([8, 4, 4])
        """
        if not sampler_kwargs.get("strict_length", True):
            raise ValueError(
                f"slices of {self.N} steps must be whole, so strict_length=False cannot be: use an "
                "OnlineHistoryStorage, which pads the histories of an episode's first steps"
            )
        cat_frames = CatFrames(self.N, self.dim, self.in_keys, self.out_keys, reset_key="_reset")
        _, sampler = cat_frames.make_rb_transform_and_sampler(batch_size, **sampler_kwargs)
        history = History(
            self.N,
            self.in_keys,
            self.out_keys,
            observation_ndim=self._observation_ndim,
            padding=self.padding,
        )
        made = [*self.out_keys, *(unravel_key(("next", key)) for key in self.out_keys)]
        transform = Compose(
            lambda steps: steps.reshape(-1, self.N),
            history,
            lambda slices: slices[:, -1],
            ExcludeTransform(*made, inverse=True),
        )
        return transform, sampler

    def _check_observation(self, key: NestedKey, specs: Composite) -> None:
        if key not in specs.keys(True, True):
            raise KeyError(
                f"History found no observation {key!r} in the environment, which has "
                f"{sorted(map(str, specs.keys(True, True)))}; name one of these in in_keys."
            )
        ndim = observation_ndim(key, specs)
        if self._observation_ndim not in (None, ndim):
            shape = list(specs[key].shape[specs[key].ndim - ndim :])
            raise ValueError(
                f"One observation {key!r} has the shape {shape}, so observation_ndim "
                f"must be {ndim}, not {self._observation_ndim}"
            )


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


def _key_list(name: str, keys: Sequence[NestedKey] | str) -> list[NestedKey]:
    if not isinstance(keys, Iterable):
        raise TypeError(
            f"{name} must be keys, not {keys!r}; History takes no dim as CatFrames does, but the "
            "number of an observation's dimensions, observation_ndim"
        )
    return [unravel_key(key) for key in ([keys] if isinstance(keys, str) else keys)]


def _without_next(
    in_keys: list[NestedKey], out_keys: list[NestedKey]
) -> tuple[list[NestedKey], list[NestedKey]]:
    """Leaves out the keys of next observations, whose histories are those of the others, moved."""
    pairs = dict(zip(in_keys, out_keys, strict=True))
    following = {unravel_key(("next", k)): unravel_key(("next", out)) for k, out in pairs.items()}
    pairs = {key: out for key, out in pairs.items() if following.get(key) != out}
    for key, out in pairs.items():
        if isinstance(key, tuple) and key[0] == "next":
            raise ValueError(
                f"the history {out!r} of {key!r} cannot be made: name the observation itself too, "
                'and its history under "next" like the one at the root'
            )
    return list(pairs), list(pairs.values())


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


def find_histories(
    steps: TensorDictBase, keys: Sequence[NestedKey], num_frames: int, padding: Padding
) -> Windows:
    """Finds the windows of steps drawn from a replay buffer; each stays within its slice.

    A window reaches back at most to the start of its episode or slice: t = 0, "is_init", a step
    after a done step, or one whose observation differs from the previous step's next observation.

    Args:
        steps: [*B, T], where the last dimension is time; flat batches [slices * steps] also work.
        keys: keys of the observations.
        num_frames: number K of frames in a window.
        padding: what replaces frames before a window's first valid one.

    Returns:
        Windows [*B, T, K] on the steps in order.

    Raises:
        ValueError: if the steps are single ones, or the starts cannot be found.

    Example:
        >>> from tensordict import TensorDict
        >>> frames, flags = torch.arange(4.0).view(4, 1), torch.zeros(4, 1, dtype=torch.bool)
        >>> following = TensorDict({"observation": frames + 1, "done": flags}, [4])
        >>> slices = TensorDict({"observation": frames, "next": following}, [4])[[0, 1, 0, 1]]
        >>> find_histories(slices, ["observation"], num_frames=2, padding="same").rows
        tensor([[0, 0],
                [0, 1],
                [2, 2],
                [2, 3]])
    """
    if not steps.ndim:
        raise ValueError("a single step has no history: the last dimension must be time")
    time = steps.ndim - 1
    starts = torch.zeros(steps.batch_size, dtype=torch.bool, device=steps[keys[0]].device)
    is_init, done = steps.get("is_init", None), steps.get(("next", "done"), None)
    if is_init is not None:
        starts |= is_init.flatten(time + 1).any(-1) if is_init.ndim > time + 1 else is_init
    if done is not None:
        starts[..., 1:] |= done[..., :-1, :].any(-1)
    starts[..., 0] = True
    starts |= _breaks(steps, keys, starts, known=done is not None)
    rows = torch.arange(starts.numel(), device=starts.device).view(starts.shape)
    oldest = torch.where(starts, rows, -1).cummax(time).values
    return find_windows(rows, oldest, num_frames, padding)


def same_observations(left: TensorDictBase, right: TensorDictBase) -> Tensor:
    """Whether all entries of observations [...] are the same, NaN included; bool [...].

    Example:
        >>> from tensordict import TensorDict
        >>> x = TensorDict({"observation": torch.tensor([[1.0, torch.nan], [2.0, 0.0]])}, [2])
        >>> same_observations(x, x), same_observations(x[:1], x[1:])
        (tensor([True, True]), tensor([False]))
    """
    pairs = ((entry, right[key]) for key, entry in left.items(True, True))
    return ~torch.stack([differs(*pair, left.ndim) for pair in pairs]).any(0)


def _breaks(
    steps: TensorDictBase, keys: Sequence[NestedKey], starts: Tensor, known: bool
) -> Tensor:
    """Where a step does not follow the one before, bool [*B, T]."""
    breaks = torch.zeros_like(starts)
    if any(steps.get(unravel_key(("next", key)), None) is None for key in keys):
        if not known or (steps.ndim == 1 and steps.names[0] != "time"):
            raise ValueError(
                "nothing tells where slices of these steps begin: store the next observations too, "
                'or reshape the steps to [slices, steps] and store ("next", "done")'
            )
        return breaks
    now, following = steps.select(*keys), steps["next"].select(*keys)
    breaks[..., 1:] = ~same_observations(now[..., 1:], following[..., :-1])
    inside = ~starts
    if (breaks & inside).sum() > (inside.sum() / 2):
        raise ValueError(
            "most of these steps do not follow the one before them, so they are no slices and have "
            "no histories: draw them with a SliceSampler, or store them in an "
            "OnlineHistoryStorage, which makes the histories of single steps"
        )
    return breaks
