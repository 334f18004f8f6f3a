"""Converts specs and values of any TorchRL environment to those of our environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
)

from torchrl_tit.envs.action_masks import MASK
from torchrl_tit.envs.actions import box_action_spec
from torchrl_tit.envs.spaces import array_spec, by_name, choose, group, leaf_name
from torchrl_tit.modules.action_specs import describe
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import ImageLayout

Convert = Callable[[Tensor], Tensor]

# Entries that TorchRL's own transforms add to the observations.
_BOOKKEEPING = {"episode_reward", "is_init", "step_count", "traj_ids"}


class TensorReader:
    """Reads the observations of a TorchRL environment without batch dimensions.

    Args:
        specs: the specs of its observations.
        keys: names of the observations to keep, or of groups of them; by default, all except the
            counters of TorchRL's transforms.
        image_layout: see :class:`~torchrl_tit.envs.spaces.ObservationReader`.
        mask_actions: whether "action_mask" is the mask of the actions instead of an observation.

    Raises:
        ValueError: if no observation is of a supported kind, or one of ``keys`` is not; if a key is
            unknown; if there is no mask; or if the layout of an image cannot be inferred.

    Example:
        >>> from torchrl.envs import PendulumEnv
        >>> reader = TensorReader(PendulumEnv().full_observation_spec, keys=["th", "thdot"])
        >>> reader.spec["th"].shape
        torch.Size([1])
    """

    @checked_arguments
    def __init__(
        self,
        specs: Composite,
        *,
        keys: Sequence[str] = (),
        image_layout: ImageLayout = "auto",
        mask_actions: bool = False,
    ) -> None:
        found = by_name((_name(key), (key, specs[key])) for key in specs.keys(True, True))
        self.mask_key: NestedKey | None = None
        """Key of the action mask, if it is read."""
        if mask_actions:
            if MASK not in found:
                raise ValueError(
                    f'The task has no mask of its actions, an observation "{MASK}": leave out '
                    "mask_actions."
                )
            self.mask_key = found.pop(MASK)[0]
        if not keys:
            found = {name: leaf for name, leaf in found.items() if name not in _BOOKKEEPING}
        chosen = choose(found, keys, lambda leaf: _sizes(leaf[1]) or _is_array(leaf[1]))
        read = {name: _observation(name, leaf[1], image_layout) for name, leaf in chosen.items()}
        self.spec = group({name: spec for name, (spec, _) in read.items()})
        """The spec of the only observation, or a `Composite` of all."""
        self._leaves = {name: (chosen[name][0], convert) for name, (_, convert) in read.items()}

    def __call__(self, tensordict: TensorDictBase) -> Any:
        """Reads the only observation, or each by its name."""
        values = {
            name: convert(tensordict.get(key)) for name, (key, convert) in self._leaves.items()
        }
        return next(iter(values.values())) if len(values) == 1 else values


def action_spec(found: TensorSpec, *, clip: bool) -> tuple[TensorSpec, Convert]:
    """Converts the spec of a TorchRL environment's action.

    Args:
        found: its spec, without batch dimensions.
        clip: whether continuous actions are clipped to their bounds, so that their spec is
            unbounded.

    Returns:
        The spec of our action, and the function that converts ours, [*batch, *spec], to the
        environment's.

    Raises:
        ValueError: if the action is of an unsupported kind.

    Example:
        >>> spec, convert = action_spec(OneHot(3), clip=True)
        >>> type(spec).__name__, convert(torch.tensor(2))
        ('Categorical', tensor([False, False,  True]))
    """
    sizes, shape, dtype = _sizes(found), found.shape, found.dtype
    spec: TensorSpec

    def shaped(action: Tensor) -> Tensor:
        return action.reshape((*action.shape[: action.ndim - spec.ndim], *shape)).to(dtype)

    def one_hot(action: Tensor) -> Tensor:
        batch = action.shape[: action.ndim - spec.ndim]
        choices = zip(action.reshape(*batch, len(sizes)).unbind(-1), sizes, strict=True)
        vectors = [x.unsqueeze(-1) == torch.arange(n, device=x.device) for x, n in choices]
        return torch.cat(vectors, -1).reshape(*batch, *shape).to(dtype)

    if isinstance(found, Binary):
        spec = Binary(shape.numel(), shape=(shape.numel(),), dtype=torch.int8)
        return spec, shaped
    if sizes:
        spec = Categorical(sizes[0]) if len(sizes) == 1 else MultiCategorical(sizes)
        return spec, one_hot if isinstance(found, OneHot | MultiOneHot) else shaped
    if _is_array(found) and dtype.is_floating_point:
        bounded = isinstance(found, Bounded)
        low = found.space.low if bounded else torch.full(shape, -torch.inf)
        high = found.space.high if bounded else torch.full(shape, torch.inf)
        spec = box_action_spec(low.reshape(-1).numpy(), high.reshape(-1).numpy(), clip=clip)
        return spec, lambda x: shaped(x).clamp(low, high) if clip else shaped(x)
    raise ValueError(
        f"Actions of the kind {describe(found)} are not supported, only floats, Categorical, "
        "MultiCategorical, OneHot, MultiOneHot and Binary."
    )


def _name(key: NestedKey) -> str:
    """The name of an observation; an enclosing group "observation" is left out."""
    parts = [key] if isinstance(key, str) else list(key)
    return leaf_name(parts[1:] if parts[0] == "observation" and len(parts) > 1 else parts)


def _is_array(spec: TensorSpec) -> bool:
    return isinstance(spec, Unbounded | Bounded) and not spec.dtype.is_complex


def _sizes(spec: TensorSpec) -> list[int]:
    """The number of categories of each entry; empty if there are none or it is unknown."""
    if isinstance(spec, MultiCategorical | MultiOneHot):
        sizes = torch.as_tensor(spec.nvec).flatten().tolist()
        groups = spec.shape.numel() // (sum(sizes) if isinstance(spec, MultiOneHot) else len(sizes))
        return [int(size) for size in sizes] * groups
    if isinstance(spec, Binary):
        return [2] * spec.shape.numel()
    if isinstance(spec, OneHot):
        return [int(spec.space.n)] * spec.shape[:-1].numel()
    if isinstance(spec, Categorical) and spec.space.n > 0:
        return [int(spec.space.n)] * spec.shape.numel()
    return []


def _observation(name: str, spec: TensorSpec, layout: ImageLayout) -> tuple[TensorSpec, Convert]:
    sizes = _sizes(spec)
    if not sizes:
        ours, channels_last = array_spec(name, spec.shape, spec.dtype, layout)

        def bring(value: Tensor) -> Tensor:
            value = value.movedim(-1, 0) if channels_last else value
            return value.to(ours.dtype).reshape(ours.shape)

        return ours, bring
    if isinstance(spec, OneHot | MultiOneHot):
        return MultiCategorical(sizes), lambda value: spec.to_categorical(value).long().reshape(-1)
    return MultiCategorical(sizes), lambda value: value.long().reshape(-1)
