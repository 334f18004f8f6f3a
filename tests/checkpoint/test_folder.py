import itertools
import json
import multiprocessing
import os
import pickle
import resource
import shutil
import signal
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import SafetensorError

from torchrl_tit.checkpoint import (
    CheckpointError,
    CheckpointNotFoundError,
    checkpoint_steps,
    contents,
    latest_step,
    load_checkpoint,
    save_checkpoint,
)


def make_state(step: int) -> dict[str, Any]:
    return {"step": step, "weights": {"a": torch.full((50,), float(step)), "b": torch.tensor(step)}}


def assert_state(state: dict[str, Any], step: int) -> None:
    assert state["step"] == step
    assert state["weights"]["a"].equal(torch.full((50,), float(step)))
    assert state["weights"]["b"].equal(torch.tensor(step))


def run(function: Callable[..., None], *args: object) -> int | None:
    """Runs a function in a process of its own, and returns its exit code."""
    process = multiprocessing.Process(target=function, args=args)
    process.start()
    process.join()
    return process.exitcode


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


def test_newest_or_chosen(tmp_path: Path) -> None:
    folder = tmp_path / "run" / "checkpoints"
    for step in (0, 20480, 1024):
        path = save_checkpoint(folder, step, make_state(step), keep=5)
        assert path == folder / f"{step:012d}"
        assert sorted(os.listdir(path)) == ["state.json", "tensors.safetensors"]
    assert checkpoint_steps(folder) == [0, 1024, 20480]
    assert latest_step(folder) == 20480
    for asked, expected in ((None, 20480), (1024, 1024), (0, 0)):
        step, state = load_checkpoint(folder, asked)
        assert step == expected
        assert_state(state, expected)


def test_old_ones_rotate_out(tmp_path: Path) -> None:
    for step in range(6):
        save_checkpoint(tmp_path, step, make_state(step), keep=2)
        assert checkpoint_steps(tmp_path) == list(range(step + 1))[-2:]
    # Continued from an earlier step: the new one stays, and what came later is not ours to remove.
    save_checkpoint(tmp_path, 2, make_state(2), keep=1)
    assert checkpoint_steps(tmp_path) == [2, 4, 5]
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_other_files_in_the_folder_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "best").mkdir()
    for step in range(3):
        save_checkpoint(tmp_path, step, {}, keep=1)
    assert sorted(os.listdir(tmp_path)) == ["000000000002", "best", "notes.txt"]


def test_the_same_step_again(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 7, make_state(1))
    save_checkpoint(tmp_path, 7, make_state(2))
    step, state = load_checkpoint(tmp_path)
    assert step == 7
    assert_state(state, 2)
    assert os.listdir(tmp_path) == ["000000000007"]


def test_what_cannot_be_saved_touches_nothing(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"state\['x'\]"):
        save_checkpoint(tmp_path / "new", 1, {"x": object()})
    with pytest.raises(ValueError, match="-1"):
        save_checkpoint(tmp_path / "new", -1, {})
    with pytest.raises(ValueError, match="keep"):
        save_checkpoint(tmp_path / "new", 1, {}, keep=0)
    assert not (tmp_path / "new").exists()


def test_no_checkpoint(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        assert checkpoint_steps(folder) == []
        assert latest_step(folder) is None
        with pytest.raises(CheckpointNotFoundError, match=f"no checkpoint in {folder}"):
            load_checkpoint(folder)
    save_checkpoint(tmp_path, 5, {})
    with pytest.raises(FileNotFoundError, match=r"step 6.*only of 5"):
        load_checkpoint(tmp_path, 6)


@pytest.mark.parametrize(
    ("target", "error"),
    [
        (("save_file", contents), SafetensorError("I/O error: No space left on device")),
        (("fsync_file", contents), OSError(28, "No space left on device")),
        (("rename", os), OSError(28, "No space left on device")),
        (("mkdir", Path), OSError(28, "No space left on device")),
        (("save_file", contents), KeyboardInterrupt()),
    ],
)
def test_failing_while_saving(tmp_path: Path, monkeypatch, target, error) -> None:
    save_checkpoint(tmp_path, 1, make_state(1), keep=1)
    before = snapshot(tmp_path)
    name, owner = target

    def fail(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, fail)
        if isinstance(error, KeyboardInterrupt):
            with pytest.raises(KeyboardInterrupt):
                save_checkpoint(tmp_path, 2, make_state(2), keep=1)
        else:
            with pytest.raises(CheckpointError, match=f"step 2 .*{tmp_path}.*No space left"):
                save_checkpoint(tmp_path, 2, make_state(2), keep=1)
    assert snapshot(tmp_path) == before
    save_checkpoint(tmp_path, 2, make_state(2), keep=1)
    assert checkpoint_steps(tmp_path) == [2]


def save_on_a_full_disk(folder: Path, limit: int, output: Path) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    message = ""
    try:
        save_checkpoint(folder, 2, {"weight": torch.ones(1_000_000)})
    except CheckpointError as error:
        message = str(error)
    output.write_text(f"{message}\n{load_checkpoint(folder)[0]}")


def check_full_disk(folder: Path, limit: int) -> None:
    save_checkpoint(folder, 1, make_state(1))
    before = snapshot(folder)
    output = folder.with_name("output")
    assert run(save_on_a_full_disk, folder, limit, output) == 0
    message, loaded = output.read_text().splitlines()
    assert f"step 2 could not be saved in {folder}" in message
    assert loaded == "1"
    assert snapshot(folder) == before


def test_a_limit_of_the_operating_system(tmp_path: Path) -> None:
    check_full_disk(tmp_path / "folder", 100_000)


def test_a_really_full_disk(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("needs the right to mount a small disk")
    try:
        check_full_disk(folder, resource.RLIM_INFINITY)
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def expect_refusal(folder: Path, reason: str) -> None:
    path = folder / "000000000002"
    with pytest.raises(CheckpointError, match=reason) as caught:
        load_checkpoint(folder)
    assert str(path) in str(caught.value)
    assert "Delete that folder to fall back" in str(caught.value)
    shutil.rmtree(path)
    step, state = load_checkpoint(folder)  # what the message says works
    assert step == 1
    assert_state(state, 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for step in (1, 2):
        save_checkpoint(tmp_path, step, make_state(step))
    return tmp_path


@pytest.mark.parametrize("length", [0, 5, 100, -1])
def test_truncated_tensors(folder: Path, length: int) -> None:
    file = folder / "000000000002" / "tensors.safetensors"
    file.write_bytes(file.read_bytes()[:length])
    expect_refusal(folder, "tensors.safetensors has .* bytes")


@pytest.mark.parametrize("place", [3, 20, -1])
def test_a_flipped_bit_in_the_tensors(folder: Path, place: int) -> None:
    file = folder / "000000000002" / "tensors.safetensors"
    content = bytearray(file.read_bytes())
    content[place] ^= 4
    file.write_bytes(content)
    expect_refusal(folder, "tensors.safetensors was changed")


def test_a_flipped_digit_in_the_state(folder: Path) -> None:
    file = folder / "000000000002" / "state.json"
    text = file.read_text()
    assert '"state": {"step": 2' in text
    file.write_text(text.replace('"state": {"step": 2', '"state": {"step": 3'))
    expect_refusal(folder, "state.json was changed")


@pytest.mark.parametrize(
    "text", ["", "{", "[" * 100_000, '{"format": "x"}', "[]", "null", "\0"], ids=lambda t: t[:9]
)
def test_broken_or_foreign_json(folder: Path, text: str) -> None:
    (folder / "000000000002" / "state.json").write_text(text)
    expect_refusal(folder, "not valid JSON|does not say that it is")


def test_json_that_is_not_text(folder: Path) -> None:
    (folder / "000000000002" / "state.json").write_bytes(b"\xff\xfe\x00")
    expect_refusal(folder, "not valid JSON")


def test_another_version(folder: Path) -> None:
    file = folder / "000000000002" / "state.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"version": 99}))
    expect_refusal(folder, "version 99")


def test_renamed_to_another_step(folder: Path) -> None:
    shutil.rmtree(folder / "000000000002")
    shutil.copytree(folder / "000000000001", folder / "000000000002")
    expect_refusal(folder, "saved at step 1, not at 2")


@pytest.mark.parametrize("name", ["state.json", "tensors.safetensors"])
def test_missing_file(folder: Path, name: str) -> None:
    (folder / "000000000002" / name).unlink()
    expect_refusal(folder, f"{name} is missing")


def test_link_instead_of_a_file(folder: Path) -> None:
    file = folder / "000000000002" / "state.json"
    file.rename(folder / "elsewhere")
    file.symlink_to(folder / "elsewhere")
    expect_refusal(folder, "not a plain file")


class Trap:
    """Unpickling this makes a file, and so would be seen."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


@pytest.mark.parametrize("name", ["data.pkl", "policy.pt", "extra.pickle", ".hidden", "x.json"])
def test_planted_file(folder: Path, tmp_path: Path, name: str) -> None:
    (folder / "000000000002" / name).write_bytes(pickle.dumps(Trap(tmp_path / "sprung")))
    expect_refusal(folder, f"unknown files: {name}")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("name", ["state.json", "tensors.safetensors"])
@pytest.mark.parametrize("packed", [False, True])
def test_pickle_in_place_of_a_file(folder: Path, tmp_path: Path, name: str, packed: bool) -> None:
    file = folder / "000000000002" / name
    trap = pickle.dumps(Trap(tmp_path / "sprung"))
    if packed:  # what torch.save writes
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("archive/data.pkl", trap)
    else:
        file.write_bytes(trap)
    expect_refusal(folder, ".")
    assert not (tmp_path / "sprung").exists()


def make_whole(value: int) -> dict[str, Any]:
    return {"value": value, "weight": torch.full((50,), float(value))}


def save_and_die(folder: Path, step: int, after: int) -> None:
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

    for name in ("fsync", "rename", "mkdir", "unlink", "rmdir", "open"):
        setattr(os, name, fragile(getattr(os, name)))
    contents.save_file = fragile(contents.save_file)
    save_checkpoint(folder, step, make_whole(2), keep=1)
    os._exit(0)


@pytest.mark.parametrize("second", [2, 1], ids=["next step", "same step"])
def test_killed_at_every_single_point(tmp_path: Path, second: int) -> None:
    """After each death, this process loads, like a resumed run."""
    folder, first = tmp_path / "checkpoints", 1
    for after in range(1000):
        shutil.rmtree(folder, ignore_errors=True)
        save_checkpoint(folder, first, make_whole(1), keep=1)
        status = run(save_and_die, folder, second, after)
        assert checkpoint_steps(folder)
        for found in checkpoint_steps(folder):  # whatever has a number is whole
            step, state = load_checkpoint(folder, found)
            value = state["value"]
            assert state["weight"].equal(torch.full((50,), float(value)))
            assert step == (first if value == 1 else second), after
        save_checkpoint(folder, second, make_whole(3), keep=1)
        assert load_checkpoint(folder)[1]["value"] == 3
        assert os.listdir(folder) == [f"{second:012d}"]
        if status == 0:
            break
        assert status == -signal.SIGKILL
    assert 10 <= after < 999


def save_for_ever(folder: Path) -> None:
    for step in itertools.count(
        latest_step(folder) or 0
    ):  # the first one again, like a resumed run
        weight = torch.full((100_000,), float(step))
        save_checkpoint(folder, step, {"step": step, "weight": weight}, keep=2)


def test_killed_at_any_moment(tmp_path: Path) -> None:
    reached = -1
    for delay in (0.05, 0.31, 0.173):
        process = multiprocessing.Process(target=save_for_ever, args=(tmp_path,))
        process.start()
        while (latest_step(tmp_path) or -1) <= reached:
            assert process.is_alive()
        process.join(delay)
        assert process.is_alive()
        process.kill()
        process.join()
        step, state = load_checkpoint(tmp_path)
        assert step > reached
        reached = step
        assert state["step"] == step
        assert state["weight"].equal(torch.full((100_000,), float(step)))


def test_both_files_are_read_by_the_same_people(tmp_path):
    folder = save_checkpoint(tmp_path, 1, {"weight": torch.ones(2)})
    modes = {path.stat().st_mode & 0o777 for path in folder.iterdir()}
    (tmp_path / "other").touch()  # with the mode that this process gives to files
    assert modes == {(tmp_path / "other").stat().st_mode & 0o777}
