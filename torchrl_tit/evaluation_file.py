"""The file evaluation.json of a run or an agent: what it holds, and how it is read."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from statistics import fmean, pstdev
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

EVALUATION = "evaluation.json"
BEST_EVALUATION = "evaluation_best.json"
"""That of a run's best weights, which an agent has under the first name."""
MOST_BYTES = 2**24
"""Far more than any file of text in a run or an agent has, so that none fills the memory."""
MOST_STEPS = 2**53
"""Larger whole numbers are not those of any run, and floats do not hold them exactly."""
_LARGEST = 3.4e38  # of float32, the dtype of rewards
_ROUNDING = 1e-5  # of the magnitude of the returns

_Number = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
_Spread = Annotated[float, Meta(ge=0, le=_LARGEST)]
Steps = Annotated[int, Meta(ge=0, le=MOST_STEPS)]


class _Score(msgspec.Struct):
    best: _Number
    last: _Number


class _Evaluation(msgspec.Struct):
    """The entries of an evaluation that others rely on."""

    env: str
    episodes: Annotated[int, Meta(ge=1)]
    seed: Annotated[int, Meta(ge=0, le=2**31)]
    returns: list[_Number]
    mean: _Number
    std: _Spread
    steps: Steps
    score: _Score | UnsetType = UNSET
    score_std: _Spread | UnsetType = UNSET


class _OfData(msgspec.Struct):
    """The entries of an evaluation without an environment."""

    env: Literal[""]
    dataset: str
    steps: Steps
    held_out: Annotated[dict[str, _Number], Meta(min_length=1)]
    held_out_episodes: Annotated[int, Meta(ge=1)]


def check_evaluation(evaluation: Mapping[str, Any]) -> None:
    """Raises ValueError if an evaluation lacks an entry that others rely on, or one is invalid.

    Without an environment they are ``steps``, the ``dataset``, and what was measured on
    ``held_out_episodes`` of it, ``held_out``. Otherwise they are the task ``env``, the number of
    ``episodes``, the ``seed`` of the first, their ``returns``, the ``mean`` and population ``std``
    of these, and the ``steps`` of training before. The command ``evaluate`` writes them.

    Example:
        >>> numbers = {"episodes": 1, "seed": 0, "mean": 9.0, "std": 0.0, "steps": 100}
        >>> check_evaluation({"env": "CartPole-v1", "returns": [9.0], **numbers})
        >>> check_evaluation({"env": "CartPole-v1", "returns": "many", **numbers})
        Traceback (most recent call last):
        ...
        ValueError: evaluation.json is not that of a run: Expected `array`, got `str` - at ...
    """
    try:
        if "returns" not in evaluation and "held_out" in evaluation:
            msgspec.convert(evaluation, _OfData)
            return
        msgspec.convert(evaluation, _Evaluation)
    except msgspec.ValidationError as error:
        raise ValueError(f"{EVALUATION} is not that of a run: {error}") from error
    returns = evaluation["returns"]
    if len(returns) != evaluation["episodes"]:
        raise ValueError(f"{EVALUATION} does not have a return for each of its 'episodes'")
    tolerance = _ROUNDING * max(1.0, *map(abs, returns))
    for name, value in (("mean", fmean(returns)), ("std", pstdev(map(float, returns)))):
        if not abs(evaluation[name] - value) <= tolerance:
            raise ValueError(
                f"{EVALUATION} has the {name!r} {evaluation[name]}, but that of its 'returns' is "
                f"{value}"
            )


def read_evaluation(folder: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Reads and checks the evaluation in the folder of a run or an agent; None if there is none.

    Raises:
        ValueError: if it is not what :func:`check_evaluation` accepts; the message names the file.

    Example:
        >>> read_evaluation("nowhere") is None
        True
    """
    with suppress(FileNotFoundError), Path(folder, EVALUATION).open("rb") as file:
        return parse_evaluation(file.read(MOST_BYTES + 1), folder)  # one more is refused
    return None


def parse_evaluation(content: bytes, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads and checks the content of an evaluation.

    Args:
        content: the content of its file.
        folder: the folder that it is from, for messages.

    Raises:
        ValueError: as in :func:`read_evaluation`.
    """
    try:
        check_size(EVALUATION, len(content), MOST_BYTES)
        evaluation = parse_object(content, EVALUATION)
        check_evaluation(evaluation)
        return evaluation
    except (RecursionError, ValueError) as error:
        raise ValueError(
            f"{Path(folder, EVALUATION)} is damaged: `evaluate {folder}` writes it again ({error})"
        ) from error


def check_size(name: str, size: int, most: int) -> None:
    """Raises ValueError if a file has more bytes than it may have."""
    if size > most:
        raise ValueError(f"{name} has {size} bytes, more than the {most} that an agent's may have")


def parse_object(content: bytes, name: str) -> dict[str, Any]:
    """Parses a JSON object; raises ValueError, which names the file, if it is none."""
    try:
        parsed = json.loads(content)
    except (RecursionError, ValueError) as error:
        raise ValueError(f"{name} is not valid JSON ({error})") from error
    if not isinstance(parsed, dict):
        raise ValueError(f"{name} is not a JSON object")
    return parsed


def is_number(value: Any) -> bool:
    """Whether a value is a finite number of float32's range, which JSON does not ensure.

    Example:
        >>> is_number(9.0), is_number(float("nan")), is_number(1e300), is_number(True)
        (True, False, False, False)
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST
