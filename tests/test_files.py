import os
import resource
from pathlib import Path

import pytest

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
    fsync, replace = os.fsync, os.replace

    def noted_fsync(descriptor: int) -> None:
        calls.append("fsync")
        fsync(descriptor)

    def noted_replace(source: Path, target: Path) -> None:
        calls.append("replace")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "replace", noted_replace)
    files.write_bytes_atomic(tmp_path / "x", b"x")
    assert calls == ["fsync", "replace", "fsync"]  # the file, its name, the folder


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    target = tmp_path / "missing" / "notes.txt"
    with pytest.raises(FileNotFoundError, match=r"notes.txt cannot be written: .*missing$"):
        files.write_text_atomic(target, "new")
    with (
        pytest.raises(FileNotFoundError, match=r"notes.txt cannot be written: .*missing$"),
        files.whole_or_not_at_all(target),
    ):
        raise AssertionError("nothing is made")


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch, step: str, error: BaseException
) -> None:
    target = tmp_path / "notes.txt"
    target.write_text("old")

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(type(error)):
        files.write_text_atomic(target, "new")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_a_limit_of_the_operating_system(tmp_path: Path) -> None:
    target = tmp_path / "notes.txt"
    target.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            files.write_bytes_atomic(target, bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        files.write_text_atomic(tmp_path / "nowhere" / "x", "x")


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_fails_half_way_is_not_there_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, kind: str
) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    def make() -> None:
        with files.whole_or_not_at_all(tmp_path / "made") as hidden:
            if kind == "folder":
                hidden.mkdir()
            (hidden / "inside" if kind == "folder" else hidden).write_text("half")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(KeyboardInterrupt):
        make()
    assert os.listdir(tmp_path) == []


def test_what_is_there_already_stays(tmp_path: Path) -> None:
    target = tmp_path / "made"
    with files.whole_or_not_at_all(target) as hidden:
        hidden.write_text("first")
    with (
        pytest.raises(FileExistsError, match="exists already"),
        files.whole_or_not_at_all(target) as hidden,
    ):
        hidden.write_text("second")
    assert target.read_text() == "first"
    assert os.listdir(tmp_path) == ["made"]
