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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from torchrl_tit.evaluation_file import (
    EVALUATION,
    MOST_BYTES,
    Steps,
    check_evaluation,
    check_size,
    parse_object,
)
from torchrl_tit.files import whole_or_not_at_all

CARD = "README.md"
RECIPE = "recipe.json"
WEIGHTS = "model.safetensors"
VERSIONS = "versions.json"
MANIFEST = "agent.json"

CONTENTS = (CARD, RECIPE, WEIGHTS, EVALUATION, VERSIONS)
"""The files that the manifest lists."""

# Far larger than any agent, so that no file fills the memory before it is checked.
_MOST_BYTES = {WEIGHTS: 2**32}
_FORMAT = "torchrl-tit agent"
_VERSION = 1


class _Listed(msgspec.Struct):
    sha256: str


class _Manifest(msgspec.Struct):
    steps: Steps
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
        evaluation = parse_object(contents[EVALUATION], EVALUATION)
        check_evaluation(evaluation)
        return AgentFiles(
            folder,
            manifest.steps,
            contents[RECIPE],
            _tensors(contents[WEIGHTS]),
            evaluation,
            parse_object(contents[VERSIONS], VERSIONS),
        )
    except (MemoryError, OSError, RecursionError, ValueError) as error:
        raise AgentError(f"the agent {folder} cannot be used: {error}") from error


def _read_manifest(folder: Path) -> _Manifest:
    if not is_agent(folder):
        raise ValueError(f"there is no {MANIFEST}")
    fields = parse_object(_read(folder, MANIFEST), MANIFEST)
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
    check_size(name, path.stat().st_size, _MOST_BYTES.get(name, MOST_BYTES))
    return path.read_bytes()


def _tensors(content: bytes) -> dict[str, Tensor]:
    try:
        return load(content)
    except (SafetensorError, LookupError) as error:  # a dtype that PyTorch lacks
        raise ValueError(f"{WEIGHTS} is not a file of safetensors ({error})") from error


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
