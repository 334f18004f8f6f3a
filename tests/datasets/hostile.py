"""Files that are made to read other files, to fill the memory or to run something.

Each function writes one into a folder, and returns it. ``make fuzz`` counts them.
"""

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_tit.datasets import episodes_from_arrays, write_minari

ENDLESS = 4 * 10**8
SECRET = np.arange(40, dtype=np.float32)
"""What another file of the machine holds."""


def good_arrays(rows: int = 40) -> dict[str, np.ndarray]:
    ends = np.arange(rows) % 20 == 19
    states = np.arange(rows, dtype=np.float32)[:, None]
    return {
        "observations": states,
        "actions": states % 1,
        "rewards": np.ones(rows, np.float32),
        "terminals": ends,
    }


def _hdf5(folder: Path, change: Callable[[h5py.File, Path], None]) -> Path:
    """A good file in D4RL's layout, changed; and beside it one that it must not read."""
    other = folder / "other"
    other.write_bytes(SECRET.tobytes())
    with h5py.File(folder / "other.hdf5", "w") as file:
        file["rewards"] = SECRET
    with h5py.File(folder / "a.hdf5", "w") as file:
        for name, array in good_arrays().items():
            file[name] = array
        change(file, folder)
    return folder / "a.hdf5"


def _external(file: h5py.File, folder: Path) -> None:
    del file["rewards"]
    place = [(str(folder / "other"), 0, SECRET.nbytes)]
    file.create_dataset("rewards", SECRET.shape, np.float32, external=place)


def _virtual(file: h5py.File, folder: Path) -> None:
    del file["rewards"]
    layout = h5py.VirtualLayout(SECRET.shape, np.float32)
    layout[:] = h5py.VirtualSource(str(folder / "other.hdf5"), "rewards", SECRET.shape)
    file.create_virtual_dataset("rewards", layout)


def _external_link(file: h5py.File, folder: Path) -> None:
    del file["rewards"]
    file["rewards"] = h5py.ExternalLink(str(folder / "other.hdf5"), "rewards")


def _endless(file: h5py.File, folder: Path) -> None:
    for name, array in good_arrays().items():
        del file[name]
        shape = (ENDLESS, *array.shape[1:])
        file.create_dataset(name, shape, array.dtype, chunks=(2**20, *array.shape[1:]))


def _endless_at_once(file: h5py.File, folder: Path) -> None:
    for name, array in good_arrays().items():
        del file[name]
        file.create_dataset(name, (ENDLESS, *array.shape[1:]), array.dtype)


def _one_chunk(file: h5py.File, folder: Path) -> None:
    del file["rewards"]
    size = 625 * 10**6
    file.create_dataset("rewards", (40,), np.float32, chunks=(size,), maxshape=(None,))


def _compressed_twice(file: h5py.File, folder: Path) -> None:
    """A chunk of zeros, compressed, and once more."""
    del file["rewards"]
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk((2**24,))
    plist.set_deflate(9)
    plist.set_deflate(9)
    space = h5py.h5s.create_simple((2**26,))
    made = h5py.h5d.create(file.id, b"rewards", h5py.h5t.IEEE_F32LE, space, plist)
    made.write_direct_chunk((0,), zlib.compress(zlib.compress(bytes(2**26))))


def _minari(
    folder: Path,
    metadata: Callable[[dict[str, Any]], Any] = lambda x: x,
    change: Callable[[h5py.File, Path], None] = lambda file, folder: None,
) -> Path:
    """A good Minari data set, changed."""
    _hdf5(folder, lambda file, folder: None)
    made = folder / "walk-v0"
    write_minari(episodes_from_arrays(**good_arrays()), made, "CartPole-v1")
    path = made / "data" / "metadata.json"
    path.write_text(json.dumps(metadata(json.loads(path.read_text()))))
    with h5py.File(made / "data" / "main_data.hdf5", "a") as file:
        change(file, folder)
    return made


def _runs_something(metadata: dict[str, Any]) -> dict[str, Any]:
    """Without a space, Minari makes the environment, which is a function's result here."""
    del metadata["observation_space"]
    spec = json.loads(metadata["env_spec"])
    spec |= {"entry_point": "os:mkdir", "kwargs": {"path": "executed"}, "max_episode_steps": None}
    return metadata | {"env_spec": json.dumps(spec)}


def _endless_space(metadata: dict[str, Any]) -> dict[str, Any]:
    space = {"type": "Box", "dtype": "float64", "shape": [10**10], "low": 0.0, "high": 1.0}
    return metadata | {"observation_space": json.dumps(space)}


def _episode_elsewhere(file: h5py.File, folder: Path) -> None:
    del file["episode_0"]
    file["episode_0"] = h5py.ExternalLink(str(folder / "other.hdf5"), "/")


def _in_episode(change: Callable[[h5py.File, Path], None]) -> Callable[[h5py.File, Path], None]:
    return lambda file, folder: change(file["episode_0"], folder)


def _long_episode(file: h5py.File, folder: Path) -> None:
    file["episode_1"].attrs["total_steps"] = 10**12


def _huge_number(file: h5py.File, folder: Path) -> None:
    file["episode_1"].attrs["total_steps"] = 1e30


def _nested(metadata: dict[str, Any]) -> dict[str, Any]:
    depth = 100_000  # Python 3.13 still reads a thousand
    deep = '{"type": "Tuple", "subspaces": [' * depth + "]}" * depth
    return metadata | {"action_space": deep}


HOSTILE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "external storage": (lambda f: _hdf5(f, _external), "takes its values from other files"),
    "virtual data set": (lambda f: _hdf5(f, _virtual), "takes its values from other files"),
    "external link": (lambda f: _hdf5(f, _external_link), "'rewards': is missing"),
    "4e8 rows in chunks": (lambda f: _hdf5(f, _endless), "declares 1600000000 bytes"),
    "4e8 rows at once": (lambda f: _hdf5(f, _endless_at_once), "declares 1600000000 bytes"),
    "a chunk of 2.5 GB": (lambda f: _hdf5(f, _one_chunk), "has chunks of 2500000000 bytes"),
    "compressed twice": (lambda f: _hdf5(f, _compressed_twice), "declares 268435456 bytes"),
    "an environment that runs": (lambda f: _minari(f, _runs_something), "missing required field"),
    "1e9 episodes": (
        lambda f: _minari(f, lambda m: m | {"total_episodes": 10**9}),
        "claim 1000000000 episodes, but there are 2",
    ),
    "a space of 1e10 entries": (
        lambda f: _minari(f, _endless_space),
        "a space of 10000000000 entries lists bounds of fewer",
    ),
    "spaces in spaces": (lambda f: _minari(f, _nested), "is not a whole Minari data set"),
    "metadata of a list": (lambda f: _minari(f, lambda m: [m]), "Expected `object`, got `array`"),
    "metadata of other kinds": (
        lambda f: _minari(f, lambda m: m | {"author": 5}),
        "not a whole Minari data set .*author",
    ),
    "attributes of a list": (
        lambda f: _minari(f, lambda m: m | {"attributes": [1]}),
        "not a whole Minari data set .*attributes",
    ),
    "an environment of a number": (
        lambda f: _minari(f, lambda m: m | {"env_spec": 5}),
        "not a whole Minari data set .*env_spec",
    ),
    "an episode elsewhere": (
        lambda f: _minari(f, change=_episode_elsewhere),
        "'episode_0': is a link to another place",
    ),
    "a field elsewhere": (
        lambda f: _minari(f, change=_in_episode(_external_link)),
        "episode 0: field 'rewards': is a link to another place",
    ),
    "a virtual field": (
        lambda f: _minari(f, change=_in_episode(_virtual)),
        "episode 0: field 'rewards': takes its values from other files",
    ),
    "1e12 steps": (lambda f: _minari(f, change=_long_episode), "declares .* bytes of data, but"),
    "1e30 steps": (lambda f: _minari(f, change=_huge_number), "its episodes cannot be listed"),
}
"""Each with a part of the message that refuses it."""
