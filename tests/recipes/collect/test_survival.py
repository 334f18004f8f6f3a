"""`data collect` that is killed, gone on with, and asked for more."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recipes.collect import agents, collect, set_maker, training
from recipes.collect.settings import KINDS
from tests.recipes.collect.collected import (
    CARTPOLE,
    PENDULUM,
    assert_same,
    attributes,
    check_episodes,
    read,
)
from torchrl_tit.checkpoint import checkpoint_steps

ROOT = Path(__file__).parents[3]


class Kill(BaseException):
    """Nothing of the project catches it."""


@pytest.mark.parametrize("which", ["cartpole", "pendulum"])
def test_a_killed_collection_goes_on_to_the_same_data(
    which: str, agent: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: Any
) -> None:
    """Killed at many places, one after the other, each time a little later."""
    settings = replace(CARTPOLE, agent=agent) if which == "cartpole" else PENDULUM
    places = [
        (training.TransitionParts, "write"),
        (training.Training, "updated"),
        (training, "save_checkpoint"),
        (set_maker, "write_hdf5"),
        (set_maker, "write_minari"),
    ]
    folder, kills = tmp_path / "killed", 0
    for owner, name in places:
        for after in (1, 2, 5):
            calls = 0
            real = getattr(owner, name)

            def dying(*args: Any, _real: Any = real, _after: int = after, **kwargs: Any) -> Any:
                nonlocal calls
                calls += 1
                if calls == _after:
                    raise Kill
                return _real(*args, **kwargs)

            with monkeypatch.context() as patch:
                patch.setattr(owner, name, dying)
                try:
                    collect(settings, folder, "the command")
                except Kill:
                    kills += 1
    collect(settings, folder, "the command")

    assert kills >= 7
    assert_same(folder, request.getfixturevalue(which))


def test_what_is_finished_is_not_done_again(cartpole: Path, agent: str, monkeypatch: Any) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("this was done already")

    before = {path: path.stat().st_mtime_ns for path in cartpole.rglob("*.hdf5")}
    monkeypatch.setattr(agents, "train_ppo", refuse)
    monkeypatch.setattr(set_maker, "roll_out", refuse)
    monkeypatch.setattr(set_maker, "write_hdf5", refuse)
    monkeypatch.setattr(set_maker, "write_minari", refuse)
    lines = collect(replace(CARTPOLE, agent=agent), cartpole, "the command")
    assert [line.split(":")[0] for line in lines] == list(KINDS)
    assert {path: path.stat().st_mtime_ns for path in cartpole.rglob("*.hdf5")} == before
    assert not list(cartpole.glob("*.parts"))


def test_a_task_that_cannot_be_saved(tmp_path: Path, monkeypatch: Any) -> None:
    """Begins anew at each checkpoint, whether or not it is killed there."""
    monkeypatch.setattr("torchrl_tit.checkpoint.collector.can_save_env", lambda env: False)
    settings = replace(PENDULUM, sets=("mixed",), medium_return=None)
    collect(settings, tmp_path / "whole")
    data = read(tmp_path / "whole" / "mixed.hdf5")
    assert np.flatnonzero(data["timeouts"]).tolist() == [149, 299, 449, 599]
    check_episodes(data)

    def die_late(self: object, step: int, policy: object) -> bool:
        if step > 400:
            raise Kill
        return False

    with monkeypatch.context() as patch:
        patch.setattr(training.Training, "updated", die_late)
        with pytest.raises(Kill):
            collect(settings, tmp_path / "killed")
    collect(settings, tmp_path / "killed")
    for name, array in read(tmp_path / "killed" / "mixed.hdf5").items():
        np.testing.assert_array_equal(array, data[name])


@pytest.mark.slow
def test_killed_for_good_and_gone_on_with(pendulum: Path, tmp_path: Path) -> None:
    """By SIGKILL, from outside, at some time during the training and during the roll-out."""
    words = "Pendulum-v1 --transitions 300 --medium-return -2000 --total-steps 600 "
    words += "--evaluation-interval 200 --evaluation-episodes 2 --checkpoint-interval 150 "
    words += "--num-envs 2 --sac.hidden-dim 16 --sac.batch-size 16 --sac.random-steps 100 "
    words += f"--sac.updates-per-step 0.2 --out {tmp_path / 'killed'}"
    command = [sys.executable, "-m", "recipes", "data", "collect", *words.split()]
    checkpoints = tmp_path / "killed" / "training" / "checkpoints"

    def start() -> subprocess.Popen:
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)

    for step in (150, 400):
        process = start()
        while process.poll() is None and max(checkpoint_steps(checkpoints), default=0) < step:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    process = start()
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert_same(tmp_path / "killed", pendulum)


def test_a_mark_that_is_never_reached_and_a_longer_training(agent: str, tmp_path: Path) -> None:
    settings = replace(
        CARTPOLE, agent=agent, sets=("random", "medium"), total_steps=256, expert_return=None
    )
    with pytest.raises(ValueError, match="medium_return 100 was never reached in 256 steps"):
        collect(settings, tmp_path / "c")
    random = (tmp_path / "c" / "random.hdf5").stat().st_mtime_ns
    first = (tmp_path / "c" / "training" / "seen" / "000000000256.hdf5").stat().st_mtime_ns

    collect(replace(settings, total_steps=8192), tmp_path / "c")

    assert (tmp_path / "c" / "random.hdf5").stat().st_mtime_ns == random
    again = (tmp_path / "c" / "training" / "seen" / "000000000256.hdf5").stat().st_mtime_ns
    assert again == first
    assert attributes(tmp_path / "c" / "medium.hdf5")["agent_return"] >= 100
    with pytest.raises(ValueError, match="total_steps: 8192 -> 256"):
        collect(settings, tmp_path / "c")


def test_more_sets_later_are_those_of_one_go(cartpole: Path, agent: str, tmp_path: Path) -> None:
    settings = replace(CARTPOLE, agent=agent)
    for kinds in (("random",), ("expert",), KINDS):
        collect(replace(settings, sets=kinds), tmp_path / "c", "the command")
    assert_same(tmp_path / "c", cartpole)
