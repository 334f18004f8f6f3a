import os
from pathlib import Path

import pytest

from tests.processes import files_of_at_most
from torchrl_tit import files


def test_writes_and_replaces(tmp_path: Path) -> None:
    target = tmp_path / "notes.txt"
    files.write_text_atomic(target, "première\n")
    assert target.read_bytes() == "première\n".encode()
    files.write_bytes_atomic(target, b"second")
    assert target.read_bytes() == b"second"
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_file_is_forced_to_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch) -> None:
    calls: list[str] = []

    def noted(name: str) -> None:
        call = getattr(os, name)

        def note(*own: object) -> None:
            calls.append(name)
            call(*own)

        monkeypatch.setattr(os, name, note)

    noted("fsync")
    noted("replace")
    files.write_bytes_atomic(tmp_path / "x", b"x")
    assert calls == ["fsync", "replace", "fsync"]  # the file, its name, the folder


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    target = tmp_path / "missing" / "notes.txt"
    message = r"notes.txt cannot be written: .*missing$"
    with pytest.raises(FileNotFoundError, match=message):
        files.write_text_atomic(target, "new")
    with pytest.raises(FileNotFoundError, match=message), files.whole_or_not_at_all(target):
        raise AssertionError("nothing is made")


def make_file(target: Path) -> None:
    with files.whole_or_not_at_all(target) as hidden:
        hidden.write_text("half")


def make_folder(target: Path) -> None:
    with files.whole_or_not_at_all(target) as hidden:
        hidden.mkdir()
        (hidden / "inside").write_text("half")


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize(
    ("write", "before"),
    [(lambda p: files.write_text_atomic(p, "new"), "old"), (make_file, ""), (make_folder, "")],
)
def test_failure_leaves_what_was_there_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step, error, write, before
) -> None:
    target = tmp_path / "target"
    if before:
        target.write_text(before)

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(type(error)):
        write(target)
    assert [path.read_text() for path in tmp_path.iterdir()] == ([before] if before else [])


def test_a_limit_of_the_operating_system(tmp_path: Path) -> None:
    target = tmp_path / "notes.txt"
    target.write_text("old")
    with pytest.raises(OSError, match="File too large"), files_of_at_most(1000):
        files.write_bytes_atomic(target, bytes(100_000))
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_what_is_there_already_stays(tmp_path: Path) -> None:
    make_file(tmp_path / "made")
    for make in (make_file, make_folder):
        with pytest.raises(FileExistsError, match="exists already"):
            make(tmp_path / "made")
    assert (tmp_path / "made").read_text() == "half"
    assert os.listdir(tmp_path) == ["made"]
