"""Files that are made to read other files, to fill the memory or to run something.

Each function writes one into a folder, and returns it. ``make fuzz`` counts them.
"""

import json
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_tit.datasets import episodes_from_arrays, write_minari

Change = Callable[[h5py.File, Path], None]

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


def _hdf5(folder: Path, change: Change) -> Path:
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


def _external_way(file: h5py.File, folder: Path) -> None:
    del file["rewards"]
    file["there"] = h5py.ExternalLink(str(folder / "other.hdf5"), "/")
    file["rewards"] = h5py.SoftLink("there/rewards")


def _circle(file: h5py.File, folder: Path) -> None:
    del file["rewards"]
    file["rewards"], file["more"] = h5py.SoftLink("/more"), h5py.SoftLink("/rewards")


def _as(name: str, dtype: Any, add: Any = 0) -> Change:
    def change(file: h5py.File, folder: Path) -> None:
        values = file[name][()].astype(dtype) + np.array(add, dtype)
        del file[name]
        file[name] = values

    return change


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
    change: Change = lambda file, folder: None,
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


def _endless_space(metadata: dict[str, Any], dimensions: int = 1) -> dict[str, Any]:
    shape = [10**10] * dimensions
    space = {"type": "Box", "dtype": "uint8", "shape": shape, "low": 0, "high": 255}
    return metadata | {"observation_space": json.dumps(space), "jpeg_encoding": True}


def _episode_elsewhere(file: h5py.File, folder: Path) -> None:
    del file["episode_0"]
    file["episode_0"] = h5py.ExternalLink(str(folder / "other.hdf5"), "/")


def _in_episode(change: Change, number: int = 0) -> Change:
    return lambda file, folder: change(file[f"episode_{number}"], folder)


def _long_episode(file: h5py.File, folder: Path) -> None:
    file["episode_1"].attrs["total_steps"] = 10**12


def _many_texts(file: h5py.File, folder: Path) -> None:
    file["episode_1"].attrs["names"] = ["walk"] * 1000


def _deep_groups(file: h5py.File, folder: Path) -> None:
    nest(file.create_group("episode_0/infos"))


def _doubling_groups(file: h5py.File, folder: Path) -> None:
    """Groups that each hold the next one twice: 2^40 ways to the last."""
    group = file.create_group("episode_0/infos")
    for _ in range(40):
        inner = group.create_group("a")
        group["b"], group = inner, inner


def nest(group: h5py.Group, depth: int = 2000) -> None:
    """Creates groups in groups."""
    for _ in range(depth):
        group = group.create_group("a")


def _one_text_for_all(folder: Path) -> Path:
    """A thousand long texts, of which one is stored."""
    offset = 0

    def add(file: h5py.File, folder: Path) -> None:
        nonlocal offset
        texts = ["x" * 10**5] + ["y"] * 999
        made = file.create_dataset("episode_0/infos/texts", data=texts, dtype=h5py.string_dtype())
        file.flush()
        offset = made.id.get_offset()

    made = _minari(folder, change=add)
    path = made / "data" / "main_data.hdf5"
    content = bytearray(path.read_bytes())
    content[offset : offset + 16_000] = content[offset : offset + 16] * 1000
    path.write_bytes(content)
    return made


def _nested(metadata: dict[str, Any]) -> dict[str, Any]:
    depth = 100_000  # Python 3.13 still reads a thousand
    deep = '{"type": "Tuple", "subspaces": [' * depth + "]}" * depth
    return metadata | {"observation_space": deep}


_TRANSITIONS: dict[str, tuple[Change, str]] = {
    "external storage": (_external, "takes its values from other files"),
    "virtual data set": (_virtual, "takes its values from other files"),
    "external link": (_external_link, "'rewards': is a link to another place"),
    "external link on the way": (_external_way, "'rewards': is a link to another place"),
    "links in a circle": (_circle, "'rewards': is a link to another place"),
    "an integer of 64 bits": (
        _as("actions", np.uint64, 2**63 + 5),
        "'actions', row 0: is 9223372036854775813, but all values must be at most 9223",
    ),
    "long doubles": (
        _as("observations", np.longdouble),
        "'observations': has the dtype float128, which PyTorch lacks: store it as float64",
    ),
    "4e8 rows in chunks": (_endless, "declares 1600000000 bytes"),
    "4e8 rows at once": (_endless_at_once, "declares 1600000000 bytes"),
    "a chunk of 2.5 GB": (_one_chunk, "has chunks of 2500000000 bytes"),
    "compressed twice": (_compressed_twice, "declares 268435456 bytes"),
}
_METADATA: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "an environment that runs": (_runs_something, "missing required field"),
    "1e9 episodes": (
        lambda m: m | {"total_episodes": 10**9},
        "claim 1000000000 episodes, but there are 2",
    ),
    "spaces in spaces": (_nested, "is not a whole Minari data set"),
    "images of 1e20 bytes": (partial(_endless_space, dimensions=2), "declares .* bytes of data"),
    "metadata of a list": (lambda m: [m], "Expected `object`, got `array`"),
    "metadata of other kinds": (
        lambda m: m | {"author": 5},
        "not a whole Minari data set .*author",
    ),
    "attributes of a list": (lambda m: m | {"attributes": [1]}, "not a whole .*attributes"),
    "an environment of a number": (lambda m: m | {"env_spec": 5}, "not a whole .*env_spec"),
}
_EPISODES: dict[str, tuple[Change, str]] = {
    "an episode elsewhere": (_episode_elsewhere, "'episode_0': is a link to another place"),
    "a field elsewhere": (
        _in_episode(_external_link),
        "episode 0: field 'rewards': is a link to another place",
    ),
    "a virtual field": (
        _in_episode(_virtual),
        "episode 0: field 'rewards': takes its values from other files",
    ),
    "a later field of long doubles": (
        _in_episode(_as("rewards", np.longdouble), 1),
        "episode 1: field 'rewards': has the dtype float128",
    ),
}
HOSTILE: dict[str, tuple[Callable[[Path], Path], str]] = {
    **{name: (partial(_hdf5, change=c), message) for name, (c, message) in _TRANSITIONS.items()},
    **{name: (partial(_minari, metadata=c), message) for name, (c, message) in _METADATA.items()},
    **{name: (partial(_minari, change=c), message) for name, (c, message) in _EPISODES.items()},
}
"""Each with a part of the message that refuses it."""

HARMLESS: dict[str, Callable[[Path], Path]] = {
    "a space of 1e10 entries": partial(_minari, metadata=_endless_space),
    "many texts in an attribute": partial(_minari, change=_many_texts),
    "one text for a thousand": _one_text_for_all,
    "groups in groups": partial(_minari, change=_deep_groups),
    "groups in two places": partial(_minari, change=_doubling_groups),
    "1e12 steps": partial(_minari, change=_long_episode),
}
"""What is not read of a data set cannot fill the memory."""
