"""The first weights of a run, taken from another run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import TanhModule
from torchrl.objectives import LossModule
from torchrl.objectives.value import ValueEstimatorBase

from .algorithm import Algorithm
from .run import Run

_IN_A_BACKBONE = re.compile(r"(.*?)(frame_encoders?|history_encoder)\.")


def weights_from(folder: Path, algorithm: Algorithm[Any]) -> tuple[dict[str, Tensor], str]:
    """Takes the weights of another run's newest checkpoint that fit an algorithm's networks.

    Weights fit if they have the same name and shape; the count of observations, if their mean
    does. From a run of another algorithm, only the policy's backbone is taken, by the names within
    it. Hyperparameters that a loss keeps among its tensors, such as the discount, always come from
    the recipe.

    Args:
        folder: the other run's folder.
        algorithm: the algorithm that is to start with them.

    Returns:
        The weights by their names in ``algorithm.model``, and a line that says which were
        taken, and names those that were not.

    Raises:
        FileNotFoundError: if the folder holds no run, or no checkpoint.
        ValueError: if no weights fit, or one that does is not finite.
    """
    run = Run.open(folder)
    step, checkpoint = run.load_trained()
    with run.restoring(step):
        theirs = _tensors(checkpoint["networks"])
    own = _tensors(algorithm.model.state_dict())
    names = {name: name for name in own.keys() - _hyperparameters(own, algorithm)}
    if run.recipe.algorithm == algorithm.recipe.algorithm:
        unexpected = theirs.keys() - own.keys()
    else:
        prefix, their_prefix = _policy_backbone(own), _policy_backbone(theirs)
        names = {
            name: their_prefix + name.removeprefix("target_").removeprefix(prefix)
            for name in names
            if name.removeprefix("target_").startswith(prefix)
        }
        theirs = {name: theirs[name] for name in theirs if name.startswith(their_prefix)}
        unexpected = theirs.keys() - set(names.values())
    taken = {
        name: theirs[other]
        for name, other in names.items()
        if other in theirs and _kind(theirs[other]) == _kind(own[name])
    }
    for name in [name for name in taken if name.endswith(".count")]:
        mean = f"{name.removesuffix('count')}mean"
        if mean in own and mean not in taken:  # the count would weigh the initial mean
            del taken[name]
    reshaped = [
        f"{name} {_kind(theirs[other])} instead of {_kind(own[name])}"
        for name, other in names.items()
        if other in theirs and _kind(theirs[other]) != _kind(own[name])
    ]
    missing = [name for name, other in names.items() if other not in theirs]
    source = f"{folder} ({run.recipe.algorithm}, step {step})"
    rest = "".join(
        f"; {what}: {', '.join(sorted(which))}"
        for what, which in [
            ("missing there", missing),
            ("unexpected", unexpected),
            ("of other shapes", reshaped),
        ]
        if which
    )
    if not taken:
        raise ValueError(f"no weights of {source} fit these networks{rest}")
    for name, weight in taken.items():
        if not weight.isfinite().all():
            raise ValueError(f"{name} of {source} has entries that are not finite: it cannot start")
    return taken, f"initial weights: {len(taken)} of {len(names)} tensors from {source}{rest}"


def _tensors(state: Mapping[str, Any]) -> dict[str, Tensor]:
    return {name: value for name, value in state.items() if isinstance(value, Tensor)}


def _kind(tensor: Tensor) -> str:
    """A tensor's shape, and its dtype if that is not the default."""
    dtype = "" if tensor.dtype == torch.get_default_dtype() else f" {tensor.dtype}"
    return f"{list(tensor.shape)}{dtype}"


def _hyperparameters(names: Iterable[str], algorithm: Algorithm[Any]) -> set[str]:
    """Names of tensors that are not weights: buffers of the losses, and bounds of the actions."""
    # Losses keep them under names of their own; critics and deviations have the last two.
    bounds = (*_buffers(algorithm.policy, TanhModule), "half_range", "middle")
    of_losses = _buffers(algorithm.model, LossModule | ValueEstimatorBase)
    return {*of_losses, *(name for name in names if name.endswith(bounds))}


def _buffers(networks: nn.Module, kind: type[nn.Module] | UnionType) -> Iterator[str]:
    for prefix, module in networks.named_modules():
        if isinstance(module, kind):
            yield from (f"{prefix}.{x}".lstrip(".") for x, _ in module.named_buffers(recurse=False))


def _policy_backbone(names: Iterable[str]) -> str:
    """Prefix of the names in the first backbone, which is the policy's."""
    matches = map(_IN_A_BACKBONE.match, names)
    return next((match[1] for match in matches if match), "no backbone")
