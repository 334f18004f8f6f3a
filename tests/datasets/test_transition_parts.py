"""Transitions in parts, and the episodes that they form."""

import os
import sys
from itertools import pairwise
from pathlib import Path

import minari
import numpy as np
import pytest
import torch

from tests.datasets.rollouts import Transitions, spans
from torchrl_tit.datasets import (
    DatasetError,
    TransitionParts,
    episodes_from_arrays,
    load_episodes,
    write_hdf5,
    write_minari,
)


def split(arrays: Transitions, streams: int, steps: list[int]) -> list[Transitions]:
    """The first rows as streams [S, T], split into parts of the given numbers of steps."""
    total = sum(steps)
    side_by_side = {
        name: array[: streams * total].reshape(streams, total, *array.shape[1:])
        for name, array in arrays.items()
    }
    bounds = np.cumsum([0, *steps])
    return [
        {name: array[:, a:b] for name, array in side_by_side.items()} for a, b in pairwise(bounds)
    ]


def write_all(folder: Path, pieces: list[Transitions]) -> TransitionParts:
    parts = TransitionParts(folder)
    for number, piece in enumerate(pieces):
        parts.write(number * 10, piece)
    return parts


def test_streams_continue_from_part_to_part(arrays: Transitions, tmp_path: Path) -> None:
    parts = write_all(tmp_path / "parts", split(arrays, 3, [40, 7, 53]))

    episodes = parts.episodes()

    # An episode that is unfinished at the end of a stream is truncated there.
    expected = {name: array[:300] for name, array in arrays.items()}
    for last in (99, 199, 299):
        expected["timeouts"][last] |= not expected["terminals"][last]
    assert (episodes.rows == episodes_from_arrays(**expected).rows).all()
    assert episodes.final_known.all()
    assert episodes.finished.all()
    assert episodes.lengths.tolist() == [stop - start for start, stop in spans(expected)]
    assert episodes.rows["observation"].dtype == torch.float32
    assert episodes.left_out == ()


def test_a_restart_between_two_parts_truncates_an_episode(
    arrays: Transitions, tmp_path: Path
) -> None:
    first, lost, later = split(arrays, 1, [4, 3, 30])
    assert not (first["terminals"] | first["timeouts"]).any()

    episodes = write_all(tmp_path, [first, later]).episodes()

    assert lost["rewards"].shape == (1, 3)
    assert episodes.lengths[0] == 4
    assert episodes.truncated[0]
    np.testing.assert_array_equal(
        episodes.rows["observation"][4], first["next_observations"][0, -1]
    )
    np.testing.assert_array_equal(episodes.rows["observation"][5], later["observations"][0, 0])


def test_up_to_a_part(arrays: Transitions, tmp_path: Path) -> None:
    pieces = split(arrays, 2, [10, 20, 30])
    parts = write_all(tmp_path, pieces)
    (tmp_path / ".000000000030.hdf5.1a2b.tmp").write_bytes(b"half")

    assert parts.numbers() == [0, 10, 20]
    assert parts.numbers(last=19) == [0, 10]
    assert parts.num_rows() == 120
    assert parts.num_rows(last=10) == parts.episodes(last=10).num_transitions == 60

    parts.drop_after(10)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "000000000000.hdf5",
        "000000000010.hdf5",
    ]
    assert TransitionParts(tmp_path).num_rows() == 60


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_more_parts_than_files_may_be_open(arrays: Transitions, tmp_path: Path) -> None:
    import resource

    parts = write_all(tmp_path, split(arrays, 2, [3] * 50))
    expected = write_all(tmp_path / "few", split(arrays, 2, [150])).episodes().rows
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    opened = len(os.listdir("/proc/self/fd"))
    resource.setrlimit(resource.RLIMIT_NOFILE, (opened + 20, hard))
    try:
        rows = parts.episodes().rows
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert (rows == expected).all()


def test_a_game_of_minaris(tmp_path: Path) -> None:
    """All actions of the game, and its exact images, not those of Minari's environment."""
    frames = np.zeros((2, 84, 84), np.uint8)
    episodes = episodes_from_arrays(frames, [0, 1], [0.0, 1.0], [False, True])
    write_minari(episodes, tmp_path / "pong-v0", "ALE/Pong-v5")

    read = load_episodes(tmp_path / "pong-v0", task="ALE/Pong-v5")
    assert (read.rows == episodes.rows).all()
    dataset = minari.MinariDataset(tmp_path / "pong-v0" / "data")
    assert (dataset.action_space.n, dataset.env_spec) == (6, None)


def test_parts_that_do_not_fit(arrays: Transitions, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="contains no transitions"):
        TransitionParts(tmp_path / "none").episodes()

    parts = write_all(tmp_path / "parts", [*split(arrays, 2, [10]), *split(arrays, 3, [10])])
    with pytest.raises(DatasetError, match=r"000000000010.hdf5: .* does not fit"):
        parts.episodes()
    with pytest.raises(FileExistsError, match="exists already"):
        parts.write(10, split(arrays, 2, [10])[0])

    path = tmp_path / "parts" / "000000000010.hdf5"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DatasetError, match=r"000000000010.hdf5: is not a whole HDF5 file"):
        parts.episodes()


def test_what_goes_on_at_the_end_of_a_stream_is_not_whole(
    arrays: Transitions, tmp_path: Path
) -> None:
    """Its return says nothing, neither here nor in the files that are written."""
    (part,) = split(arrays, 2, [100])
    for name in ("terminals", "timeouts"):
        part[name] = np.zeros((2, 100), bool)
    part["terminals"][:, 60], part["timeouts"][1, 99] = True, True
    part["next_observations"][:, :-1] = part["observations"][:, 1:]
    episodes = write_all(tmp_path / "parts", [part]).episodes()
    write_hdf5(episodes, tmp_path / "a.hdf5")
    write_minari(episodes, tmp_path / "a-v0")
    read = [load_episodes(tmp_path / name) for name in ("a.hdf5", "a-v0")]
    for found in (episodes, *read):
        assert found.lengths.tolist() == [61, 39, 61, 39]
        assert found.finished.all()
        assert found.cut.tolist() == [False, True, False, False]
        assert found.whole.tolist() == [0, 2, 3]
        assert found.left_out == ()
