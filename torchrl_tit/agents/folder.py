"""The six files of an agent, written whole and checked when they are read.

folder/
    README.md            a model card, with the metadata that the Hugging Face Hub shows
    recipe.json          the settings of the training run: network, task, algorithm
    model.safetensors    the weights that acting needs
    evaluation.json      the returns of whole episodes
    versions.json        the packages that it was trained with
    agent.json           the format, and size and SHA-256 of each of the files above

The checksums detect files that were damaged or edited. They are not a signature: anyone who can
change a file can also change its checksum. Therefore nothing in these files is ever executed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, pstdev
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, UnsetType
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from torchrl_tit.files import whole_or_not_at_all

CARD = "README.md"
RECIPE = "recipe.json"
WEIGHTS = "model.safetensors"
EVALUATION = "evaluation.json"
VERSIONS = "versions.json"
MANIFEST = "agent.json"

CONTENTS = (CARD, RECIPE, WEIGHTS, EVALUATION, VERSIONS)
"""The files that the manifest lists."""

MOST_STEPS = 2**53
"""Larger whole numbers are not those of any run, and floats do not hold them exactly."""
_LARGEST = 3.4e38  # of float32, the dtype of rewards
_ROUNDING = 1e-5  # of the magnitude of the returns

# Far larger than any agent, so that no file fills the memory before it is checked.
_MOST_BYTES = {WEIGHTS: 2**32}
_MOST_BYTES_OF_TEXT = 2**24
_FORMAT = "torchrl-tit agent"
_VERSION = 1

_Number = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
_Spread = Annotated[float, Meta(ge=0, le=_LARGEST)]
_Steps = Annotated[int, Meta(ge=0, le=MOST_STEPS)]


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
    steps: _Steps
    score: _Score | UnsetType = UNSET
    score_std: _Spread | UnsetType = UNSET


class _Listed(msgspec.Struct):
    sha256: str


class _Manifest(msgspec.Struct):
    steps: _Steps
    files: dict[str, _Listed]


class AgentError(ValueError):
    """An agent does not exist or cannot be used; the message says why and what to do.

    Example:
        >>> issubclass(AgentError, ValueError)
        True
    """


@dataclass(frozen=True)
class AgentFiles:
    """The contents of an agent's files, after all checks.

    Args:
        folder: the agent's folder.
        steps: the steps that the agent was trained for.
        card: the model card, in Markdown.
        recipe: the recipe, as JSON.
        weights: tensors by name, on the CPU.
        evaluation: the returns of its episodes; see :func:`check_evaluation`.
        versions: versions of packages, by name.
    """

    folder: Path
    steps: int
    recipe: bytes
    weights: dict[str, Tensor]
    evaluation: dict[str, Any]
    versions: dict[str, Any]


def is_agent(folder: str | os.PathLike[str]) -> bool:
    """Returns whether a folder claims to be an agent's.

    Example:
        >>> is_agent("nowhere")
        False
    """
    return Path(folder, MANIFEST).is_file()


def write_agent(folder: str | os.PathLike[str], contents: Mapping[str, bytes], steps: int) -> None:
    """Writes the folder of an agent, completely or not at all.

    Args:
        folder: the folder to make; its parent must exist.
        contents: the bytes to write for each of ``CONTENTS``.
        steps: the steps that the agent was trained for.

    Raises:
        FileExistsError: if there is such a folder already.
        FileNotFoundError: if there is no parent folder.
        OSError: if it cannot be written.

    Example:
        >>> import tempfile
        >>> from safetensors.torch import save
        >>> folder = Path(tempfile.mkdtemp(), "agent")
        >>> contents = {**dict.fromkeys(CONTENTS, b"{}"), WEIGHTS: save({})}
        >>> write_agent(folder, contents, steps=100)
        >>> len(list(folder.iterdir()))
        6
    """
    listed = {
        name: {"bytes": len(contents[name]), "sha256": _sha256(contents[name])} for name in CONTENTS
    }
    manifest = {"format": _FORMAT, "version": _VERSION, "steps": steps, "files": listed}
    manifest["sha256"] = _sha256(json.dumps(manifest).encode())
    with whole_or_not_at_all(folder) as hidden:
        hidden.mkdir()
        for name in CONTENTS:
            (hidden / name).write_bytes(contents[name])
        (hidden / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")


def read_agent(folder: str | os.PathLike[str]) -> AgentFiles:
    """Reads the folder of an agent, and checks every file against its checksum.

    Other files in the folder are not read.

    Args:
        folder: the folder.

    Returns:
        The contents of its files. Nothing in them was executed.

    Raises:
        AgentError: if a file is missing, was changed after it was written, or is from another
            program or version. The message names the file.
    """
    folder = Path(folder)
    try:
        manifest = _read_manifest(folder)
        contents = {name: _read(folder, name) for name in CONTENTS}
        for name, listed in manifest.files.items():
            if name in contents and _sha256(contents[name]) != listed.sha256:
                raise ValueError(f"{name} was changed after it was written (wrong checksum)")
        evaluation = _parse(contents[EVALUATION], EVALUATION)
        check_evaluation(evaluation)
        return AgentFiles(
            folder,
            manifest.steps,
            contents[RECIPE],
            _tensors(contents[WEIGHTS]),
            evaluation,
            _parse(contents[VERSIONS], VERSIONS),
        )
    except (MemoryError, OSError, RecursionError, ValueError) as error:
        raise AgentError(f"the agent {folder} cannot be used: {error}") from error


def check_evaluation(evaluation: Mapping[str, Any]) -> None:
    """Raises ValueError if an evaluation lacks an entry that others rely on, or one is invalid.

    The entries are the task ``env``, the number of ``episodes``, the ``seed`` of the first, their
    ``returns``, the ``mean`` and population ``std`` of these, and the ``steps`` of training before.
    The command ``evaluate`` writes them.

    Example:
        >>> numbers = {"episodes": 1, "seed": 0, "mean": 9.0, "std": 0.0, "steps": 100}
        >>> check_evaluation({"env": "CartPole-v1", "returns": [9.0], **numbers})
        >>> check_evaluation({"env": "CartPole-v1", "returns": "many", **numbers})
        Traceback (most recent call last):
        ...
        ValueError: evaluation.json is not that of a run: Expected `array`, got `str` - at ...
    """
    try:
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
        return parse_evaluation(file.read(_MOST_BYTES_OF_TEXT + 1), folder)  # one more is refused
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
        _check_size(EVALUATION, len(content))
        evaluation = _parse(content, EVALUATION)
        check_evaluation(evaluation)
        return evaluation
    except (RecursionError, ValueError) as error:
        raise ValueError(
            f"{Path(folder, EVALUATION)} is damaged: `evaluate {folder}` writes it again ({error})"
        ) from error


def _read_manifest(folder: Path) -> _Manifest:
    if not is_agent(folder):
        raise ValueError(f"there is no {MANIFEST}")
    fields = _parse(_read(folder, MANIFEST), MANIFEST)
    if fields.get("format") != _FORMAT:
        raise ValueError(f"{MANIFEST} does not say that it is a {_FORMAT}")
    if fields.get("version") != _VERSION:
        raise ValueError(
            f"it has version {fields.get('version')!r}, and this torchrl-tit reads {_VERSION}"
        )
    if fields.pop("sha256", None) != _sha256(json.dumps(fields).encode()):
        raise ValueError(f"{MANIFEST} was changed after it was written (wrong checksum)")
    try:
        manifest = msgspec.convert(fields, _Manifest)
    except msgspec.ValidationError as error:
        raise ValueError(f"{MANIFEST} is not an agent's: {error}") from error
    if missing := [name for name in CONTENTS if name not in manifest.files]:
        raise ValueError(f"{MANIFEST} does not list {missing[0]}")
    return manifest


def _read(folder: Path, name: str) -> bytes:
    """Reads a file once, so that the bytes that are used are those that were checked."""
    path = folder / name
    if not path.is_file():
        raise ValueError(f"{name} is missing")
    _check_size(name, path.stat().st_size)
    return path.read_bytes()


def _check_size(name: str, size: int) -> None:
    most = _MOST_BYTES.get(name, _MOST_BYTES_OF_TEXT)
    if size > most:
        raise ValueError(f"{name} has {size} bytes, more than the {most} that an agent's may have")


def _tensors(content: bytes) -> dict[str, Tensor]:
    try:
        return load(content)
    except (SafetensorError, LookupError) as error:  # a dtype that PyTorch lacks
        raise ValueError(f"{WEIGHTS} is not a file of safetensors ({error})") from error


def _parse(content: bytes, name: str) -> dict[str, Any]:
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


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
