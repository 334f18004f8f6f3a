"""Frame encoders for several observations: by name, or chosen by the kind of observation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace

import torch

from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Observation, Observations, read_observations
from torchrl_tit.networks.building import BrokenEncoderError, build_frame
from torchrl_tit.settings import (
    Flat,
    FrameSettings,
    Inner,
    Linear,
    NatureCNNFrames,
    Network,
    resolve,
)
from torchrl_tit.settings.checks import nearest

_WIDTH = 64
_MOST_PATCHES = 1024
_CNN_PIXELS = 36


def frames_by_kind(settings: Network, observation: Observations) -> dict[str, FrameSettings]:
    """Chooses the settings of the frame encoder of each observation.

    ``settings.frames`` gives those of some observations. If one other observation is left, it gets
    ``settings.frame``. If several are left, each gets the first of these that can read it, all of
    the same width:

    1. ``settings.frame``, unless it is flat: flat frames are as wide as their observations, so they
       cannot be concatenated;
    2. the same with the patch size "auto";
    3. for arrays and categories, a linear layer; for images, NatureCNN, or an inner transformer if
       they have fewer than 36 pixels per side.

    Args:
        settings: those of the network.
        observation: shape or spec of an observation, or of each by name if there are several.

    Raises:
        ValueError: if ``settings.frames`` names an observation that does not exist, or no encoder
            can read an observation; the message names it and its kind.

    Example:
        >>> from torchrl.data import MultiCategorical
        >>> from torchrl_tit.settings.networks import enhanced_tit, mlp
        >>> task = {"image": (3, 56, 56), "direction": MultiCategorical([4])}
        >>> chosen = frames_by_kind(mlp(), task)
        >>> chosen["image"], chosen["direction"]
        (NatureCNNFrames(embed_dim=64), Linear(embed_dim=64, bias=True, activation='none'))
        >>> frames_by_kind(enhanced_tit(patch_size=12), task)["image"].patch_size
        'auto'
    """
    observations = read_observations(observation)
    for name in settings.frames:
        if name not in observations:
            raise ValueError(
                f"frames names the observation {name!r}, which the task does not have: "
                f"{nearest(name, observations)}"
            )
    if len(observations) == 1:
        return {name: settings.frames.get(name, settings.frame) for name in observations}
    if getattr(resolve(settings.history.builds), "reads_frames", False):
        raise ValueError(
            f"{settings.history.name} stacks the frames of one observation, but the task has "
            f"several ({', '.join(observations)}): choose one of them (--observation-keys), or "
            "another history encoder"
        )
    width = _width(settings, observations)
    return {
        name: settings.frames.get(name) or _first_that_reads(settings.frame, width, seen, name)
        for name, seen in observations.items()
    }


def chosen_by_kind(settings: Network, frames: Mapping[str, FrameSettings]) -> str:
    """Describes the frame encoders that settings do not name, in a few words; "" if there are none.

    Args:
        settings: those of the network.
        frames: what :func:`frames_by_kind` returned.

    Example:
        >>> from torchrl_tit.settings.networks import mlp
        >>> chosen_by_kind(mlp(), frames_by_kind(mlp(), {"arm": (7,), "ball": (3,)}))
        'arm: linear (embed_dim 64, bias True); ball: linear (embed_dim 64, bias True)'
    """
    described = []
    for name, frame in frames.items():
        if frame != settings.frames.get(name, settings.frame):
            differing = [
                f"{field.name} {getattr(frame, field.name)}"
                for field in fields(frame)
                if getattr(frame, field.name) != field.default
            ]
            described.append(f"{name}: {frame.name} ({', '.join(differing)})".replace(" ()", ""))
    return "; ".join(described)


def _width(settings: Network, observations: Mapping[str, Observation]) -> int:
    """The width of a token, which all frame encoders share: of those named, else of the first."""
    candidates = [(frame, name) for name, frame in settings.frames.items()]
    if not isinstance(settings.frame, Flat):
        candidates += [
            (settings.frame, name) for name in observations if name not in settings.frames
        ]
    for frame, name in candidates:
        encoder = _try(frame, observations[name])
        if isinstance(encoder, FrameEncoder):
            return encoder.width
    return int(getattr(settings.frame, "embed_dim", _WIDTH))


def _first_that_reads(
    frame: FrameSettings, width: int, observation: Observation, name: str
) -> FrameSettings:
    refusal = None
    for candidate in _candidates(frame, width, observation):
        encoder = _try(candidate, observation)
        if isinstance(encoder, FrameEncoder):
            return candidate
        refusal = encoder
    raise ValueError(
        f"no frame encoder here reads {name}, {observation}: name one in frames "
        f"(--backbone.frames.{name}), or leave it out (--observation-keys): {refusal}"
    )


def _candidates(
    frame: FrameSettings, width: int, observation: Observation
) -> Iterator[FrameSettings]:
    patch_size = getattr(frame, "patch_size", None)
    pixels = math.prod(observation.shape[-2:]) if observation.kind == "image" else 0
    too_many_patches = isinstance(patch_size, int) and pixels > _MOST_PATCHES * patch_size**2
    if not isinstance(frame, Flat) and not too_many_patches:
        yield frame
    if hasattr(frame, "patch_size"):
        yield replace(frame, patch_size="auto")  # type: ignore[call-arg]
    if observation.kind != "image":
        yield Linear(embed_dim=width, bias=True)
        return
    if min(observation.shape[-2:]) >= _CNN_PIXELS:
        yield NatureCNNFrames(embed_dim=width)
    yield Inner(embed_dim=width, patch_size="auto", every_block=False)


def _try(frame: FrameSettings, observation: Observation) -> FrameEncoder | ValueError:
    """Builds an encoder, or returns its error if it cannot read the observation.

    Raises:
        BrokenEncoderError: if the encoder cannot be built for any observation.
    """
    try:
        try:
            with torch.device("meta"):
                return build_frame(frame, observation)
        except (NotImplementedError, RuntimeError):  # needs real tensors, to load weights
            with torch.random.fork_rng(devices=[]):
                return build_frame(frame, observation)
    except BrokenEncoderError:
        raise
    except ValueError as error:
        return error
