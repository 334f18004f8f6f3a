"""Builds the encoders of a network, and checks that a user's own keep their contract."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Observation
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape


class BrokenEncoderError(ValueError):
    """An encoder that cannot be built, whatever the observation."""


def build_frames(
    frames: Mapping[str, settings.FrameSettings], observations: Mapping[str, Observation]
) -> dict[str, FrameEncoder]:
    """Builds the frame encoder of each observation.

    Args:
        frames: settings for each observation by name.
        observations: what they read.

    Raises:
        ValueError: if an observation has no frame encoder, or one that cannot read it, or one that
            does not output the tokens that it promises.
    """
    if frames.keys() != observations.keys():
        raise ValueError(
            f"there are frame encoders for {', '.join(frames)}, but observations "
            f"{', '.join(observations)}: name one for each"
        )
    encoders = {}
    for name, observation in observations.items():
        try:
            encoders[name] = build_frame(frames[name], observation)
        except ValueError as error:
            if len(observations) == 1:
                raise
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
    # A function that builds encoders does not declare what they read.
    kinds = getattr(settings.resolve(frame.builds), "kinds", (observation.kind,))
    if observation.kind not in kinds:
        other = "nature-cnn, resnet, inner" if observation.kind == "image" else "inner, linear"
        raise ValueError(
            f"{frame.name} frames do not read {observation}: take {other} or flat frames, or name "
            f"{observation.kind!r} in the kinds of your own encoder"
        )
    categories = {} if observation.categories is None else {"categories": observation.categories}
    encoder = _build(frame, FrameEncoder, observation.shape, **categories)
    if _is_own(frame):
        _check_output(
            encoder,
            ("num_tokens", "width"),
            observation.zeros(1, 2),
            partial(observation.draw, 2, 2),
            "map [..., *observation_shape] to tokens [..., num_tokens, width]",
        )
    return encoder


def build_history(history: settings.HistorySettings, shape: HistoryShape) -> HistoryEncoder:
    """Builds a history encoder.

    Args:
        history: its settings.
        shape: shape of its input.

    Raises:
        ValueError: if it cannot read tokens of that shape, or does not output what it promises.
    """
    encoder = _build(history, HistoryEncoder, shape)
    if encoder.is_recurrent != history.is_recurrent:
        raise BrokenEncoderError(
            f"history encoder {history.name} builds a {type(encoder).__name__}, whose is_recurrent "
            f"is {encoder.is_recurrent}: write `is_recurrent = {encoder.is_recurrent}` in "
            f"{type(history).__name__}, too"
        )
    if _is_own(history) and not encoder.context and not history.is_recurrent:  # reads only tokens
        tokens = (shape.num_frames, shape.num_tokens, shape.width)
        _check_output(
            encoder,
            ("out_features",),
            torch.zeros(1, 2, *tokens),
            partial(torch.rand, 2, 2, *tokens),
            "map [..., K, L, D] to [..., out_features]",
        )
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


def _is_own(part: settings.Part) -> bool:
    """Whether an encoder is from outside this library, and so needs these checks."""
    return not part.builds.startswith("torchrl_tit.")


def _build(part: settings.Part, base: type[Any], *args: Any, **kwargs: Any) -> Any:
    """Builds an encoder; whatever its constructor raises is said in one line."""
    called = f"{part.kind} {part.name} ({part.builds})"
    try:
        encoder = part.build(*args, **kwargs)
    except Exception as error:
        # On the device "meta", an encoder may need real tensors.
        on_meta = torch.empty(0).is_meta and isinstance(error, NotImplementedError | RuntimeError)
        if isinstance(error, ValueError) or on_meta or not _is_own(part):
            raise
        hint = (
            ": an encoder of categories takes them as an argument" if "categories" in kwargs else ""
        )
        raise BrokenEncoderError(f"{called} cannot be built: {_reason(error)}{hint}") from error
    if not isinstance(encoder, base):
        raise BrokenEncoderError(
            f"{called} builds a {type(encoder).__name__}, which is no {base.__name__}: derive it "
            f"from {base.__module__.rpartition('.')[0]}.{base.__name__}"
        )
    return encoder


def _check_output(
    encoder: nn.Module,
    attributes: tuple[str, ...],
    zeros: Tensor,
    draw: Callable[[], Tensor],
    contract: str,
) -> None:
    """Encodes zeros, then what is drawn, [2, 2, ...]; raises ValueError if the output is wrong."""
    name, base = type(encoder).__name__, type(encoder).__mro__[1]
    if not all(attribute in vars(encoder) for attribute in ("_modules", *attributes)):
        raise BrokenEncoderError(
            f"{name} does not call {base.__name__}'s constructor: call "
            f"super().__init__{inspect.signature(base)} first"
        )
    if zeros.is_meta:
        return
    given, inputs = zeros, f"zeros of shape {tuple(zeros.shape)}"
    with evaluating(encoder), torch.random.fork_rng(devices=[]), torch.no_grad():
        try:
            output, given = encoder(zeros), draw()
            first, again = encoder(given.clone()), encoder(given.clone())
            alone = encoder(given[:1, :1].clone())
        except Exception as error:
            read = inputs if given is zeros else f"inputs of shape {tuple(given.shape)}"
            raise ValueError(f"{name} fails on {read}: {_reason(error)}") from error
    got = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
    expected = (1, 2, *(getattr(encoder, attribute) for attribute in attributes))
    if got != expected:
        raise ValueError(f"{name} maps {inputs} to {got}, not to {expected}: it must {contract}")
    default = torch.get_default_dtype()
    if output.is_floating_point() and output.dtype != default:
        raise ValueError(f"{name} maps {inputs} to {output.dtype}, not to {default}")
    if not _are_close(first, again):
        raise ValueError(
            f"{name} gives the same input another output at the next call, in evaluation mode: it "
            "must depend on its input alone, without noise and without what it was called with "
            "before"
        )
    if not _are_close(first[:1, :1], alone):
        raise ValueError(
            f"the output of {name} for one entry of a batch depends on the others: it must read "
            "each by itself (nn.BatchNorm does in evaluation mode)"
        )


def _are_close(one: Tensor, other: Tensor) -> bool:
    tolerance = 1e-4 * max(1.0, one.abs().max().item())
    return torch.allclose(one.float(), other.float(), atol=tolerance, rtol=0, equal_nan=True)


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


@contextmanager
def evaluating(module: nn.Module) -> Iterator[None]:
    """Puts a module into evaluation mode, and restores the mode of each of its parts at the end.

    Example:
        >>> dropout = nn.Dropout()
        >>> with evaluating(dropout):
        ...     dropout.training
        False
        >>> dropout.training
        True
    """
    modes = {part: part.training for part in module.modules()}
    module.eval()
    try:
        yield
    finally:
        for part, training in modes.items():
            part.training = training
