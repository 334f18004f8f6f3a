"""The last K observations of an environment, under a key of their own."""

from collections.abc import Sequence
from typing import Literal, get_args

from tensordict import NestedKey, unravel_key
from torchrl.data import Composite
from torchrl.envs import EnvBase
from torchrl.envs.transforms import CatFrames, Compose, Transform, UnsqueezeTransform

Padding = Literal["same", "constant"]


class History(Compose):
    """Writes the last K observations, oldest first, and keeps the observation itself.

    A composition of TorchRL's `UnsqueezeTransform` and `CatFrames` that leaves a new axis of length
    K before the observation's own dimensions: an observation of shape ``[..., *obs]`` becomes a
    history of shape ``[..., K, *obs]`` and the same dtype, so images stay uint8 in memory. The
    newest observation stands last. When an episode ends, ``("next", history)`` holds the terminal
    observation, and the next episode starts with a fresh history. With K = 1 nothing is stored.

    Args:
        num_frames: K, the number of observations in a history, at least 1.
        in_keys: Keys of the observations: a list, whose entries may be nested, or one name.
        out_keys: Keys of the histories, one for each of ``in_keys``, none of which they may repeat.
        observation_ndim: Number of dimensions of one observation: 1 for arrays [D], 2 for grey
            images [H, W], 3 for images [C, H, W].
        padding: What stands for the steps before an episode's first: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.

    Raises:
        TypeError: If ``num_frames`` or ``observation_ndim`` is not an integer.
        ValueError: If one of them is too small, the padding is unknown, the keys do not pair up,
            or, when an environment takes the transform, its observation does not have
            ``observation_ndim`` dimensions.
        KeyError: If an environment that takes the transform has no such observation.

    Source: "Transformer in Transformer as Backbone for Deep Reinforcement Learning" (arXiv
    2212.14538), section 3: the outer transformer reads the observations of the last K steps.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), History(num_frames=4))
        >>> env.rollout(max_steps=2)["history"].shape
        torch.Size([2, 4, 4])
    """

    def __init__(
        self,
        num_frames: int,
        in_keys: Sequence[NestedKey] | str = ("observation",),
        out_keys: Sequence[NestedKey] | str = ("history",),
        *,
        observation_ndim: int = 1,
        padding: Padding = "same",
    ) -> None:
        check_history(num_frames, padding)
        _check_integer("observation_ndim", observation_ndim, minimum=0)
        observations, histories = _key_list(in_keys), _key_list(out_keys)
        _check_keys(observations, histories)

        axis = -(observation_ndim + 1)
        transforms: list[Transform] = [
            UnsqueezeTransform(axis, in_keys=observations, out_keys=histories)
        ]
        if num_frames > 1:
            transforms.append(CatFrames(num_frames, axis, in_keys=histories, padding=padding))
        super().__init__(*transforms)
        self._observations = observations
        self._observation_ndim = observation_ndim

    def set_container(self, container: Transform | EnvBase) -> None:
        """Joins an environment, or a composition of transforms, and checks the observations there.

        Args:
            container: What the transform becomes a part of.

        Raises:
            KeyError: If the environment has no such observation.
            ValueError: If an observation does not have ``observation_ndim`` dimensions.
        """
        super().set_container(container)
        # The environment as it is before this transform; none yet for a composition on its own.
        if self.parent is not None:
            self._check_observations(self.parent.full_observation_spec)

    def _check_observations(self, specs: Composite) -> None:
        for key in self._observations:
            if key not in specs.keys(True, True):
                raise KeyError(
                    f"History found no observation {key!r} in the environment, which has "
                    f"{sorted(map(str, specs.keys(True, True)))}; name one of these in in_keys."
                )
            # The dimensions of the observation's own group are batch; the rest is the observation.
            group = specs if isinstance(key, str) else specs[key[:-1]]
            shape = specs[key].shape[group.ndim :]
            if len(shape) != self._observation_ndim:
                raise ValueError(
                    f"One observation {key!r} has the shape {list(shape)}, so observation_ndim "
                    f"must be {len(shape)}, but is {self._observation_ndim}."
                )


def check_history(num_frames: int, padding: str) -> None:
    """Checks the two settings that say what a history is.

    Args:
        num_frames: The number of observations in a history.
        padding: What stands for the steps before an episode's first.

    Raises:
        TypeError: If ``num_frames`` is not an integer.
        ValueError: If ``num_frames`` is less than 1 or the padding is unknown.

    Example:
        >>> check_history(4, "zeros")
        Traceback (most recent call last):
        ...
        ValueError: padding must be one of 'same', 'constant', but is 'zeros'.
    """
    _check_integer("num_frames", num_frames, minimum=1)
    if padding not in get_args(Padding):
        known = ", ".join(map(repr, get_args(Padding)))
        raise ValueError(f"padding must be one of {known}, but is {padding!r}.")


def _check_integer(name: str, value: int, minimum: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(f"{name} must be an integer, but is {value!r}.")
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, but is {value}.")


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
            f"A history has a key of its own, but in_keys={in_keys} and out_keys={out_keys} "
            f"name one twice; choose others."
        )
