"""Detects early if an encoder from outside this library breaks its contract."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Observation
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape


class BrokenEncoderError(ValueError):
    """An encoder that cannot be built, whatever the observation."""


def build_part(part: settings.Part, *args: Any, **kwargs: Any) -> Any:
    """Builds the encoder that settings describe.

    Raises:
        BrokenEncoderError: if it cannot be built, with the reason in one line.
    """
    if part.builds.startswith("torchrl_tit."):  # our own have tests
        return part.build(*args, **kwargs)
    called = f"{part.kind} {part.name} ({part.builds})"
    try:
        if "categories" in kwargs and not _takes_categories(settings.resolve(part.builds)):
            raise BrokenEncoderError(
                f"{called} names 'categories' in its kinds, but its constructor takes no "
                "categories: add the argument `categories=None`, the number of values of each entry"
            )
        return part.build(*args, **kwargs)
    except ValueError:
        raise
    except Exception as error:  # a user's constructor can raise anything
        if torch.empty(0).is_meta and isinstance(error, (NotImplementedError, RuntimeError)):
            raise  # it may need real tensors
        hint = ": call super().__init__ first" if "before Module.__init__()" in str(error) else ""
        raise BrokenEncoderError(f"{called} cannot be built: {_reason(error)}{hint}") from error


def is_own(encoder: object) -> bool:
    """Whether an encoder's class is from outside this library, and so needs these checks."""
    return not type(encoder).__module__.startswith("torchrl_tit.")


def check_contract(
    encoder: Any, base: type[nn.Module], attributes: Sequence[str], part: settings.Part
) -> None:
    """Raises BrokenEncoderError without the base class, its ``__init__`` call or a ``forward``."""
    cls: Any = type(encoder)
    if not isinstance(encoder, base):
        raise BrokenEncoderError(
            f"{part.builds} builds a {cls.__name__}, which is no {base.__name__}: derive it from "
            f"{base.__module__.rpartition('.')[0]}.{base.__name__}"
        )
    if "_modules" not in vars(encoder) or not all(hasattr(encoder, name) for name in attributes):
        raise BrokenEncoderError(
            f"{cls.__name__} does not call {base.__name__}'s constructor: call "
            f"super().__init__{inspect.signature(base)} first"
        )
    if cls.forward is base.forward:
        documented = (inspect.getdoc(base.forward) or "").splitlines()[0].lower().rstrip(".")
        names = ", ".join(list(inspect.signature(base.forward).parameters)[1:])
        raise BrokenEncoderError(
            f"{cls.__name__} has no forward: implement `forward(self, {names})`, which "
            f"{documented} (see {base.__name__})"
        )


def check_tokens(encoder: FrameEncoder, observation: Observation) -> None:
    """Encodes zeros once, and raises ValueError if the outputs are not the promised tokens."""
    cls = type(encoder).__name__
    if encoder.observation_shape != observation.shape:
        raise ValueError(
            f"{cls} says that it reads observations of shape {encoder.observation_shape}, not "
            f"{observation.shape}: give FrameEncoder the observation_shape as it is"
        )
    _check_output(
        encoder,
        observation.zeros(1, 2),
        (1, 2, encoder.num_tokens, encoder.width),
        f"map [..., *observation_shape] to tokens [..., L, D], with its num_tokens "
        f"{encoder.num_tokens} for L and its width {encoder.width} for D",
    )


def check_features(encoder: HistoryEncoder, shape: HistoryShape) -> None:
    """Encodes zeros once, and raises ValueError if the output is not the promised vector."""
    if encoder.context or (encoder.is_recurrent and shape.num_frames == 1):
        return  # it reads more than tokens
    _check_output(
        encoder,
        torch.zeros(1, 2, shape.num_frames, shape.num_tokens, shape.width),
        (1, 2, encoder.out_features),
        f"map [..., K, L, D] to [..., E], with its out_features {encoder.out_features} for E",
    )


def _check_output(
    encoder: nn.Module, zeros: Tensor, expected: tuple[int, ...], contract: str
) -> None:
    if torch.empty(0).is_meta:
        return
    called = f"{type(encoder).__name__} {{}} zeros of shape {tuple(zeros.shape)}"
    with _evaluating(encoder), torch.no_grad():
        try:
            output = encoder(zeros)
        except Exception as error:
            raise ValueError(f"{called.format('fails on')}: {_reason(error)}") from error
    got = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
    if got != expected:
        raise ValueError(f"{called.format('maps')} to {got}, not to {expected}: it must {contract}")


def _takes_categories(builder: Any) -> bool:
    parameters = inspect.signature(builder).parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    return "categories" in parameters or inspect.Parameter.VAR_KEYWORD in kinds


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


@contextmanager
def _evaluating(module: nn.Module) -> Iterator[None]:
    """Switches dropout off, and leaves batch statistics and random generators unchanged."""
    modes = {child: child.training for child in module.modules()}
    module.eval()
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        for child, training in modes.items():
            child.training = training
