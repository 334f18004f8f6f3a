"""Writes Minari data sets."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from torchrl_tit.datasets.episodes import Episodes, check_final_observations
from torchrl_tit.datasets.full_disks import errors_named, new_hdf5
from torchrl_tit.datasets.minari import ATTRIBUTES, FIELDS, METADATA_FIELDS, is_minari_name
from torchrl_tit.datasets.optional import minari
from torchrl_tit.datasets.tasks import task_spaces
from torchrl_tit.envs import is_atari
from torchrl_tit.files import whole_or_not_at_all


def write_minari(
    episodes: Episodes, name: str | os.PathLike[str], env_name: str | None = None
) -> None:
    """Writes episodes as a Minari data set, one at a time.

    Fields keep their dtypes. Minari writes its metadata; this function writes the episodes, in
    Minari's layout, because it survives a full disk. The attributes "algorithm", "description",
    "author", "author_email" and "code_permalink" also go into Minari's own metadata.

    Args:
        episodes: The data.
        name: The folder to create, an absolute path or one that begins with a dot, whose last part
            ends in a version such as "-v0"; or the name of a data set in Minari's own folder.
        env_name: The Gymnasium task of the data, from which Minari can recreate the environment.
            For Atari games it only determines the action space, because the environment that Minari
            recreates has different images from :func:`~torchrl_tit.envs.make_env`.

    Raises:
        FileExistsError: If the data set exists already.
        ValueError: If Minari does not accept the name, or Gymnasium does not know the task.
        DatasetError: If the final observation of a truncated episode is unknown.
        OSError: If it cannot be written.

    Example:
        >>> import tempfile
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> folder = Path(tempfile.mkdtemp()) / "walk-v0"
        >>> episodes = episodes_from_arrays(np.ones((2, 2)), np.ones((2, 1)), np.ones(2), [0, 1])
        >>> write_minari(episodes, folder)
        >>> minari.MinariDataset(folder / "data")[0].observations.shape
        (3, 2)
    """
    check_final_observations(episodes)
    folder, dataset_id = _target(name)
    action_space = _action_space(episodes) if env_name is None else task_spaces(env_name).action
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_or_not_at_all(folder) as hidden, errors_named(folder):
        hidden.mkdir()
        storage = minari.dataset.minari_storage.MinariStorage.new(
            hidden / "data",
            observation_space=_box(episodes.rows["observation"]),
            action_space=action_space,
            env_spec=_env_spec(env_name),
            jpeg_encoding=False,  # images are stored losslessly
        )
        data = hidden / "data" / "main_data.hdf5"
        with new_hdf5(data, folder) as (file, check):
            for number, steps in enumerate(_steps(episodes)):
                group = file.create_group(f"episode_{number}")
                group.attrs.update({"id": number, "total_steps": len(steps["rewards"])})
                for field, values in steps.items():
                    shape = (None, *values.shape[1:])  # resizable, like Minari's own
                    group.create_dataset(field, data=values, chunks=True, maxshape=shape)
                check()
        storage.update_metadata(
            {
                "dataset_id": dataset_id,
                "minari_version": minari.__version__,
                "total_episodes": len(episodes.lengths),
                "total_steps": episodes.num_transitions,
                "dataset_size": storage.get_size(),
                ATTRIBUTES: dict(episodes.attributes),
                **_listed(episodes),
            }
        )


def _target(name: str | os.PathLike[str]) -> tuple[Path, str]:
    """Returns the folder to write to, and the data set's name."""
    path = Path(name)
    if path.is_absolute() or str(name).startswith("."):
        folder, dataset_id = path.absolute(), path.name  # Minari cannot handle relative paths
    else:
        folder = minari.storage.datasets_root_dir.get_dataset_path(str(name))
        dataset_id = str(name)
    if not is_minari_name(dataset_id):
        raise ValueError(
            f"{dataset_id!r} is not a valid name of a Minari data set: it must end in a version, "
            f"as 'medium-v0' does."
        )
    return folder, dataset_id


def _env_spec(env_name: str | None) -> EnvSpec | None:
    return None if env_name is None or is_atari(env_name) else gymnasium.spec(env_name)


def _listed(episodes: Episodes) -> dict[str, Any]:
    """The attributes that have a field in Minari's metadata."""
    known = {place: episodes.attributes.get(name) for name, place in METADATA_FIELDS.items()}
    people = {place: known.pop(place) for place in ("author", "author_email")}
    texts = {place: value for place, value in known.items() if isinstance(value, str)}
    names = {place: [v] if isinstance(v, str) else v for place, v in people.items()}
    return {**texts, **{place: set(v) for place, v in names.items() if isinstance(v, list)}}


def _action_space(episodes: Episodes) -> gymnasium.Space:
    actions = episodes.rows["action"]
    if actions.ndim == 1:
        return Discrete(int(actions.max()) + 1)
    return _box(actions)


def _box(values: torch.Tensor) -> Box:
    """A space of arrays whose bounds are unknown."""
    array = values[:1].numpy()
    floating = np.issubdtype(array.dtype, np.floating)
    low = -np.inf if floating else np.iinfo(array.dtype).min
    high = np.inf if floating else np.iinfo(array.dtype).max
    return Box(low, high, array.shape[1:], array.dtype.type)


def _steps(episodes: Episodes) -> Iterator[dict[str, NDArray]]:
    """The fields of each episode by Minari's names."""
    for first, last in zip(episodes.first_rows.tolist(), episodes.last_rows.tolist(), strict=True):
        steps = {
            name: episodes.rows[field][first : last + 1 + more].numpy()
            for field, (name, more) in FIELDS.items()
        }
        for name in ("rewards", "terminations", "truncations"):
            steps[name] = steps[name].squeeze(-1)
        yield steps
