"""Builds the frame encoders of a network, and detects early if one breaks its contract."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from torch import nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Kind, Observation
from torchrl_tit.networks.own_encoders import build_part, check_contract, check_tokens, is_own


def build_frames(
    frame: settings.FrameSettings | Mapping[str, settings.FrameSettings],
    observations: Mapping[str, Observation],
) -> dict[str, FrameEncoder]:
    """Builds the frame encoder of each observation.

    Args:
        frame: settings for each observation by name, or settings that all share.
        observations: what they read.

    Raises:
        ValueError: if an observation has no frame encoder, or one that cannot read it, or one that
            does not output the tokens that it promises.
    """
    frames = frame if isinstance(frame, Mapping) else dict.fromkeys(observations, frame)
    if frames.keys() != observations.keys():
        raise ValueError(
            f"there are frame encoders for {', '.join(frames)}, but observations "
            f"{', '.join(observations)}: name one for each"
        )
    if len(observations) == 1:
        return {name: build_frame(frames[name], seen) for name, seen in observations.items()}
    encoders = {}
    for name, observation in observations.items():
        try:
            encoders[name] = build_frame(frames[name], observation)
        except ValueError as error:
            raise ValueError(f"observation {name!r}: {error}") from error
    return encoders


def build_frame(frame: settings.FrameSettings, observation: Observation) -> FrameEncoder:
    """Builds the frame encoder of one observation.

    Args:
        frame: its settings.
        observation: what it reads.

    Raises:
        ValueError: see :func:`build_frames`.

    Example:
        >>> build_frame(settings.Linear(), Observation((2,), categories=(4, 3)))
        LinearFrameEncoder(...)
    """
    if observation.categories is None:
        encoder = build_part(frame, observation.shape)
    else:
        # A function that builds encoders does not declare kinds.
        _check_kind(getattr(settings.resolve(frame.builds), "kinds", ()), frame, observation)
        encoder = build_part(frame, observation.shape, categories=observation.categories)
    if is_own(encoder):
        attributes = ("observation_shape", "num_tokens", "width")
        check_contract(encoder, FrameEncoder, attributes, frame)
        _check_kind(encoder.kinds, frame, observation)
        check_tokens(encoder, observation)
    return encoder


def module_names(names: Iterable[str]) -> list[str]:
    """Turns names of observations into names of modules, which are unique and have no dots.

    Example:
        >>> module_names(["arm/left", "arm.left", "arm_left", "values"])
        ['arm/left', 'arm_left', 'arm_left_', 'values_']
    """
    modules: list[str] = []
    for name in names:
        module = name.replace(".", "_")
        while not module or module in modules or hasattr(nn.ModuleDict, module):
            module += "_"
        modules.append(module)
    return modules


def _check_kind(
    kinds: Sequence[Kind], frame: settings.FrameSettings, observation: Observation
) -> None:
    """Raises ValueError if an encoder does not read this kind of observation."""
    if observation.kind not in kinds:
        other = "nature-cnn, resnet, inner" if observation.kind == "image" else "inner, linear"
        raise ValueError(
            f"{frame.name} frames do not read {observation}: take {other} or flat frames, or name "
            f"{observation.kind!r} in the kinds of your own encoder"
        )
