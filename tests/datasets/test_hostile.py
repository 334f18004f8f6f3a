"""Files of others: nothing is read but what they hold, and nothing that they name is run."""

import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.datasets.hostile import HARMLESS, HOSTILE
from torchrl_tit.datasets import DatasetError, load_episodes


@pytest.fixture
def little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert grown < 200_000  # kilobytes
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_refused_in_one_line(
    tmp_path: Path, little_memory: None, case: str
) -> None:
    make, message = HOSTILE[case]
    path = make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match=message) as error:
        load_episodes(path)
    assert "\n" not in str(error.value)
    assert sorted(tmp_path.rglob("*")) == before  # what it names was not run


@pytest.mark.parametrize("case", HARMLESS)
def test_what_is_not_read_does_no_harm(tmp_path: Path, little_memory: None, case: str) -> None:
    assert load_episodes(HARMLESS[case](tmp_path)).lengths.tolist() == [20, 20]
