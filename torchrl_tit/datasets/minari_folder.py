"""Checks the folder of a Minari data set before Minari reads it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec

from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.stored import (
    attribute_fits,
    check_group,
    check_link,
    check_size,
    damage_named,
    open_hdf5,
)

_Count = Annotated[int, msgspec.Meta(ge=0)]
_Value = str | int | float | bool | None
SPACES = ("Box", "Discrete")


class _Metadata(msgspec.Struct):
    """The fields of metadata.json that Minari or this library reads; there may be others."""

    total_episodes: _Count
    total_steps: _Count
    data_format: str
    dataset_id: str
    minari_version: str
    # Without spaces, Minari makes the environment that the file names, which may run any code.
    observation_space: str
    action_space: str
    env_spec: str | None = None
    eval_env_spec: str | None = None
    jpeg_encoding: bool = True
    algorithm_name: str | None = None
    description: str | None = None
    code_permalink: str | None = None
    author: list[str] | str | None = None
    author_email: list[str] | str | None = None
    attributes: dict[str, _Value | list[Any]] = {}


class _Space(msgspec.Struct):
    """A space as Minari writes it."""

    type: str
    shape: list[_Count] = []


def check_folder(source: str, folder: Path) -> None:
    """Checks a data set's metadata: their types, and that the folder can hold what they declare.

    Args:
        source: The data set, for error messages.
        folder: The folder with "metadata.json".

    Raises:
        DatasetError: If the metadata are damaged or cannot match the folder, or observations or
            actions are not one array each.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "metadata.json").write_text('{"total_episodes": "many"}')
        >>> check_folder("walk-v0", folder)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: walk-v0: is not a whole Minari data set (Expected\
 `int`, got `str` - at `$.total_episodes`): see ...
    """
    path = folder / "metadata.json"
    try:
        text = path.read_bytes()
        metadata = msgspec.convert(json.loads(text), _Metadata)
        for space in (metadata.observation_space, metadata.action_space):
            entries = math.prod(_space(space).shape)
            if entries > len(space):  # each entry's bounds are listed
                raise ValueError(f"a space of {entries} entries lists bounds of fewer")
    except (OSError, RecursionError, ValueError) as error:
        raise DatasetError(
            source, f"is not a whole Minari data set ({error}): see {path}."
        ) from error
    for name, space in (
        ("observation", metadata.observation_space),
        ("action", metadata.action_space),
    ):
        if (kind := _space(space).type) not in SPACES:
            raise DatasetError(source, f"its {name}s are a {kind} space, but must be one array.")
    held = _num_entries(source, folder, metadata.data_format)
    if metadata.total_episodes > held:
        raise DatasetError(
            source,
            f"its metadata claim {metadata.total_episodes} episodes, but there are {held}: see "
            f"{path}.",
        )


def episodes_checked(source: str, folder: Path, count: int) -> Iterator[str]:
    """Checks each episode of a data set in HDF5 before it is read.

    Args:
        source: The data set, for error messages.
        folder: The folder with "main_data.hdf5"; data in another format are not checked.
        count: Number of the episodes.

    Yields:
        The place of each episode, for error messages.

    Raises:
        DatasetError: If an episode takes data from elsewhere, or cannot be read.
    """
    path = folder / "main_data.hdf5"
    if not path.exists():
        yield from (f"{source}: episode {number}" for number in range(count))
        return
    with open_hdf5(path) as file:
        for number in range(count):
            place = f"{source}: episode {number}"
            with damage_named(place, "cannot be read"):
                group = file[f"episode_{number}"]
            check_group(place, group)
            yield place


def check_rows(source: str, folder: Path, num_rows: int, row_bytes: int) -> None:
    """Checks that a data set can hold as many rows as it declares.

    Args:
        source: The data set, for error messages.
        folder: The folder with its files.
        num_rows: Number of the rows.
        row_bytes: Bytes of a row.

    Raises:
        DatasetError: If it cannot.
    """
    held = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    check_size(source, num_rows * row_bytes, held)


def _space(text: str) -> _Space:
    return msgspec.convert(json.loads(text), _Space)


def _num_entries(source: str, folder: Path, data_format: str) -> int:
    """Counts the possible episodes, each of which must be in the file itself."""
    if data_format != "hdf5":
        return sum(1 for _ in folder.iterdir())
    with open_hdf5(folder / "main_data.hdf5") as file, damage_named(source, "cannot be read"):
        for name in file:
            check_link(source, file, name)
            # Minari reads all of them.
            if large := [key for key in file[name].attrs if not attribute_fits(file[name], key)]:
                raise DatasetError(
                    source, f"the attribute {large[0]!r} is neither text nor a few numbers.", name
                )
        return len(file)
