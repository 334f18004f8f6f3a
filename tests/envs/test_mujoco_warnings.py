"""MuJoCo's warnings: each once, and no file."""

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from torchrl_tit.envs import gymnasium_tasks, make_env

MESSAGE = "MuJoCo: Nan, Inf or huge value in CTRL"  # at every step with such an action


@pytest.fixture(autouse=True)
def handler() -> Iterator[Callable[[Callable[[str], None] | None], None]]:
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    yield mujoco.set_mju_user_warning
    mujoco.set_mju_user_warning(before)


def test_each_warning_is_shown_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setattr(gymnasium_tasks, "_shown", set())
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what the handler raised would end the process
        env = make_env("Hopper-v5", num_envs=2, seed=0)
        env.reset()
        for _ in range(3):  # make_env itself refuses such actions
            env.base_env._env.step(np.full((2, 3), np.nan, dtype=np.float32))
        env.close()
    assert sum(MESSAGE in record.getMessage() for record in caplog.records) == 1
    assert not list(tmp_path.iterdir())


def test_a_handler_of_the_users_own_stays(
    handler: Callable[[Callable[[str], None] | None], None],
) -> None:
    seen: list[str] = []
    own = seen.append
    handler(own)
    make_env("Hopper-v5").close()
    assert mujoco.get_mju_user_warning() is own
