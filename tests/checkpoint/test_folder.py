"""A checkpoint is whole or absent, whatever happens, and nothing in one is ever executed."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import SafetensorError

from tests.processes import files_of_at_most
from torchrl_tit.checkpoint import (
    CheckpointError,
    CheckpointNotFoundError,
    checkpoint_steps,
    folder,
    latest_step,
    load_checkpoint,
    save_checkpoint,
)


def make_state(value: int) -> dict[str, Any]:
    return {"value": value, "weights": {"a": torch.full((50,), float(value))}}


def assert_state(state: dict[str, Any], value: int) -> None:
    assert state["value"] == value
    assert state["weights"]["a"].equal(torch.full((50,), float(value)))


def run(function: Callable[..., None], *args: object) -> int | None:
    """Runs a function in a process of its own, and returns its exit code."""
    process = multiprocessing.Process(target=function, args=args)
    process.start()
    process.join()
    return process.exitcode


def snapshot(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def test_newest_or_chosen(tmp_path: Path) -> None:
    checkpoints = tmp_path / "run" / "checkpoints"
    for step in (0, 20480, 1024):
        path = save_checkpoint(checkpoints, step, make_state(step), keep=5)
        assert path == checkpoints / f"{step:012d}"
        assert sorted(os.listdir(path)) == ["state.json", "tensors.safetensors"]
    assert checkpoint_steps(checkpoints) == [0, 1024, 20480]
    assert latest_step(checkpoints) == 20480
    for asked, expected in ((None, 20480), (1024, 1024), (0, 0)):
        step, state = load_checkpoint(checkpoints, asked)
        assert step == expected
        assert_state(state, expected)


def test_old_ones_rotate_out_and_other_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "best").mkdir()
    for step in range(6):
        save_checkpoint(tmp_path, step, {}, keep=2)
        assert checkpoint_steps(tmp_path) == list(range(step + 1))[-2:]
    # Continued from an earlier step: the new one stays, and what came later is not ours to remove.
    save_checkpoint(tmp_path, 2, {}, keep=1)
    assert sorted(os.listdir(tmp_path)) == [*(f"{n:012d}" for n in (2, 4, 5)), "best", "notes.txt"]


def test_what_cannot_be_saved_touches_nothing(tmp_path: Path) -> None:
    for error, message, arguments in (
        (TypeError, r"state\['x'\]", (1, {"x": object()})),
        (ValueError, "-1", (-1, {})),
        (ValueError, "keep", (1, {}, 0)),
    ):
        with pytest.raises(error, match=message):
            save_checkpoint(tmp_path / "new", *arguments)
    assert not (tmp_path / "new").exists()


def test_no_checkpoint(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        assert (checkpoint_steps(path), latest_step(path)) == ([], None)
        with pytest.raises(CheckpointNotFoundError, match=f"no checkpoint in {path}"):
            load_checkpoint(path)
    save_checkpoint(tmp_path, 5, {})
    with pytest.raises(FileNotFoundError, match=r"step 6.*only of 5"):
        load_checkpoint(tmp_path, 6)


@pytest.mark.parametrize(
    ("owner", "name", "error"),
    [
        (folder, "save_file", SafetensorError("I/O error: No space left on device")),
        (os, "fsync", OSError(28, "No space left on device")),
        (os, "replace", OSError(28, "No space left on device")),
        (Path, "mkdir", OSError(28, "No space left on device")),
        (folder, "save_file", KeyboardInterrupt()),
    ],
)
def test_failing_while_saving(tmp_path: Path, monkeypatch, owner, name, error) -> None:
    save_checkpoint(tmp_path, 1, make_state(1), keep=1)
    before = snapshot(tmp_path)

    def fail(*_: object, **__: object) -> None:
        raise error

    expected: Any = (CheckpointError, f"step 2 .*{tmp_path}.*No space left")
    if isinstance(error, KeyboardInterrupt):
        expected = (KeyboardInterrupt, None)
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, fail)
        with pytest.raises(expected[0], match=expected[1]):
            save_checkpoint(tmp_path, 2, make_state(2), keep=1)
    assert snapshot(tmp_path) == before
    save_checkpoint(tmp_path, 2, make_state(2), keep=1)
    assert checkpoint_steps(tmp_path) == [2]


def test_a_limit_of_the_operating_system(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 1, make_state(1))
    before = snapshot(tmp_path)
    message = f"step 2 could not be saved in {tmp_path}"
    with pytest.raises(CheckpointError, match=message), files_of_at_most(100_000):
        save_checkpoint(tmp_path, 2, {"weight": torch.ones(1_000_000)})
    assert load_checkpoint(tmp_path)[0] == 1
    assert snapshot(tmp_path) == before


class Trap:
    """Unpickling this makes a file, and so would be seen."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def cut(file: Path, length: int) -> None:
    file.write_bytes(file.read_bytes()[:length])


def flip(file: Path, place: int) -> None:
    content = bytearray(file.read_bytes())
    content[place] ^= 4
    file.write_bytes(content)


def link(file: Path) -> None:
    file.rename(file.parents[2] / "elsewhere")
    file.symlink_to(file.parents[2] / "elsewhere")


def set_trap(file: Path, packed: bool = False) -> None:
    trap = pickle.dumps(Trap(file.parents[2] / "sprung"))
    if packed:  # what torch.save writes
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("archive/data.pkl", trap)
    else:
        file.write_bytes(trap)


def edit(file: Path, old: str, new: str) -> None:
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


TENSORS, STATE = "tensors.safetensors", "state.json"
DAMAGES: list[tuple[str, str, Callable[[Path], Any]]] = [
    *((TENSORS, f"{TENSORS} has .* bytes", lambda f, n=n: cut(f, n)) for n in (0, 5, 100, -1)),
    *((TENSORS, f"{TENSORS} was changed", lambda f, n=n: flip(f, n)) for n in (3, 20, -1)),
    (STATE, f"{STATE} was changed", lambda f: edit(f, '"value": 2', '"value": 3')),
    (STATE, "version 99", lambda f: edit(f, '"version": 1', '"version": 99')),
    *(
        (STATE, "not valid JSON|does not say that it is", lambda f, t=text: f.write_bytes(t))
        for text in (b"", b"{", b"[" * 100_000, b'{"format": "x"}', b"[]", b"null", b"\xff\xfe\0")
    ),
    (STATE, "saved at step 1, not at 2", lambda f: renamed(f.parent)),
    *((name, f"{name} is missing", lambda f: f.unlink()) for name in (STATE, TENSORS)),
    (STATE, "not a plain file", link),
    *(
        (name, f"unknown files: {name}", set_trap)
        for name in ("data.pkl", "policy.pt", "extra.pickle", ".hidden", "x.json")
    ),
    *((name, ".", set_trap) for name in (STATE, TENSORS)),
    *((name, ".", lambda f: set_trap(f, packed=True)) for name in (STATE, TENSORS)),
]


def renamed(path: Path) -> None:
    shutil.rmtree(path)
    shutil.copytree(path.with_name("000000000001"), path)


@pytest.mark.parametrize(("name", "reason", "damage"), DAMAGES)
def test_a_damaged_or_foreign_checkpoint_is_refused(tmp_path, name, reason, damage) -> None:
    for step in (1, 2):
        path = save_checkpoint(tmp_path, step, make_state(step))
    damage(path / name)
    with pytest.raises(CheckpointError, match=reason) as caught:
        load_checkpoint(tmp_path)
    assert str(path) in str(caught.value)
    assert "Delete that folder to fall back" in str(caught.value)
    assert not (tmp_path / "sprung").exists()
    shutil.rmtree(path)
    assert_state(load_checkpoint(tmp_path)[1], 1)  # what the message says works


def save_and_die(path: Path, step: int, after: int) -> None:
    """Dies at the first call that changes the disk after so many of them."""
    left = after

    def fragile(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            nonlocal left
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1
            return call(*args, **kwargs)

        return wrapper

    for name in ("fsync", "rename", "replace", "mkdir", "unlink", "rmdir", "open"):
        setattr(os, name, fragile(getattr(os, name)))
    folder.save_file = fragile(folder.save_file)
    save_checkpoint(path, step, make_state(2), keep=1)
    os._exit(0)


@pytest.mark.parametrize("second", [2, 1], ids=["next step", "same step"])
def test_killed_at_every_single_point(tmp_path: Path, second: int) -> None:
    """After each death, this process loads, like a resumed run."""
    path, first = tmp_path / "checkpoints", 1
    for after in range(1000):
        shutil.rmtree(path, ignore_errors=True)
        save_checkpoint(path, first, make_state(1), keep=1)
        status = run(save_and_die, path, second, after)
        assert checkpoint_steps(path)
        for found in checkpoint_steps(path):  # whatever has a number is whole
            step, state = load_checkpoint(path, found)
            assert_state(state, state["value"])
            assert step == (first if state["value"] == 1 else second), after
        save_checkpoint(path, second, make_state(3), keep=1)
        assert load_checkpoint(path)[1]["value"] == 3
        assert os.listdir(path) == [f"{second:012d}"]
        if status == 0:
            break
        assert status == -signal.SIGKILL
    assert 10 <= after < 999


def test_both_files_are_read_by_the_same_people(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path, 1, {"weight": torch.ones(2)})
    modes = {file.stat().st_mode & 0o777 for file in path.iterdir()}
    (tmp_path / "other").touch()  # with the mode that this process gives to files
    assert modes == {(tmp_path / "other").stat().st_mode & 0o777}
