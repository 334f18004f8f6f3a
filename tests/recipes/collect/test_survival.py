"""`data collect` that is killed, resumed, and given more sets to make."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recipes.core import runner
from recipes.tools.collect import Collection, agents
from recipes.tools.collect import collect as collecting
from recipes.tools.collect.agents import AgentInTraining
from recipes.tools.collect.collect import collect
from recipes.tools.collect.settings import KINDS
from tests.recipes.collect.collected import attributes, check_episodes, read


class Kill(BaseException):
    """Not caught by any part of the project."""


@pytest.mark.slow
def test_a_killed_collection_is_completed(
    cartpole: Path, cartpole_settings: Collection, tmp_path: Path, monkeypatch: Any
) -> None:
    """Killed at many places, one after the other; another algorithm's is below."""
    write, train = (agents.TransitionParts, "write"), (AgentInTraining, "updated")
    save, keep_agent = (runner, "_save"), (agents, "save_checkpoint")
    write_hdf5, write_minari = (collecting, "write_hdf5"), (collecting, "write_minari")
    # The place, and how often it is reached before the process is killed there.
    places: list[tuple[tuple[Any, str], int]] = [
        *((write, 1), (write_hdf5, 1), (write_minari, 1), (train, 2), (keep_agent, 1), (save, 1)),
        *((write_hdf5, 1), (write_minari, 1), (write, 1), (write_hdf5, 1), (train, 1), (save, 2)),
        *((keep_agent, 1), (write, 2), (write_minari, 1)),
    ]
    folder, kills = tmp_path / "killed", 0
    for (owner, name), after in places:
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
                collect(cartpole_settings, folder, "the command")
            except Kill:
                kills += 1
    collect(cartpole_settings, folder, "the command")

    assert kills >= 10
    check_completed(folder, cartpole)
    for kind, mark in (("medium", 100), ("expert", 130)):
        assert attributes(folder / f"{kind}.hdf5")["agent_return"] >= mark


def check_completed(folder: Path, whole: Path) -> None:
    """Data that no training is behind are the same, others are whole episodes."""
    for kind in KINDS:
        check_episodes(read(folder / f"{kind}.hdf5"))
    for name, array in read(whole / "random.hdf5").items():
        np.testing.assert_array_equal(array, read(folder / "random.hdf5")[name])


def test_what_is_finished_is_not_repeated(
    cartpole: Path, cartpole_settings: Collection, monkeypatch: Any
) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("this is finished")

    before = {path: path.stat().st_mtime_ns for path in cartpole.rglob("*.hdf5")}
    monkeypatch.setattr(agents, "train", refuse)
    monkeypatch.setattr(collecting, "play_episodes", refuse)
    monkeypatch.setattr(collecting, "write_hdf5", refuse)
    monkeypatch.setattr(collecting, "write_minari", refuse)
    lines = collect(cartpole_settings, cartpole, "the command")
    assert [line.split(":")[0] for line in lines] == list(KINDS)
    assert {path: path.stat().st_mtime_ns for path in cartpole.rglob("*.hdf5")} == before
    assert not list(cartpole.glob("*.parts"))


def test_an_episode_that_a_kill_cut_off_stays_cut_off(
    pendulum_settings: Collection, tmp_path: Path, monkeypatch: Any
) -> None:
    """Nothing saved is lost; the resumed training begins a new episode."""
    settings = replace(pendulum_settings, sets=("mixed",), medium_return=None)
    collect(settings, tmp_path / "whole")
    whole = read(tmp_path / "whole" / "mixed.hdf5")
    assert np.flatnonzero(whole["timeouts"]).tolist() == [199, 399]

    def die_late(self: object, step: int, policy: object) -> bool:
        if step > 300:
            raise Kill
        return False

    with monkeypatch.context() as patch:
        patch.setattr(AgentInTraining, "updated", die_late)
        with pytest.raises(Kill):
            collect(settings, tmp_path / "killed")
    shutil.copytree(tmp_path / "killed", tmp_path / "again")
    for name in ("killed", "again"):
        collect(settings, tmp_path / name)
    data, again = (read(tmp_path / name / "mixed.hdf5") for name in ("killed", "again"))
    assert np.flatnonzero(data["timeouts"]).tolist() == [199, 299, 399]
    check_episodes(data)
    for name, array in data.items():
        np.testing.assert_array_equal(array, again[name])
        if name != "timeouts":
            np.testing.assert_array_equal(array[:300], whole[name][:300])


def test_a_mark_that_is_never_reached_and_a_longer_training(
    cartpole_settings: Collection, tmp_path: Path
) -> None:
    settings = replace(
        cartpole_settings, sets=("random", "medium"), total_steps=256, expert_return=None
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
