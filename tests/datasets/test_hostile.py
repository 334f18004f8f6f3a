"""Files of others: nothing is read but what they hold, and nothing that they name is run."""

import resource
from pathlib import Path

import pytest

from tests.datasets.hostile import HOSTILE
from torchrl_tit.datasets import DatasetError, load_episodes


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    monkeypatch.chdir(tmp_path)
    make, message = HOSTILE[case]
    path = make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    with pytest.raises(DatasetError, match=message) as error:
        load_episodes(path)

    assert "\n" not in str(error.value)
    assert sorted(tmp_path.rglob("*")) == before  # what it names was not run
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert grown < 200_000  # kilobytes
