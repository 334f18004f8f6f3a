"""make_env makes the task that was named, seeded one copy at a time."""

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests.envs.tasks import Robot
from torchrl_tit.envs import gymnasium_tasks, make_env
from torchrl_tit.settings.imports import import_allowed


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("CartPole-v7", "'CartPole-v7'; did you mean .*CartPole-v1"),
        ("cartpole-v1", "'cartpole-v1'; did you mean .*CartPole-v1"),
        ("Hoper-v5", "'Hoper-v5'; did you mean Hopper-v5"),
        ("xyzzy", "'xyzzy'; .* of a module of yours is module:Name-v0, an Atari game ALE/Pong-v5"),
    ],
)
def test_unknown_names(name, words):
    with pytest.raises(ValueError, match=words):
        make_env(name)


@pytest.mark.filterwarnings("ignore:The observation 'speech'")
def test_processes():
    ours, expected = (
        make_env(
            f"{Robot.__module__}:Robot-v0",
            2,
            seed=0,
            num_frames=3,
            mask_actions=True,
            wrappers=["gymnasium.wrappers:TimeAwareObservation(flatten=False)"],
            vectorization_mode=mode,
        )
        for mode in ("async", "sync")
    )
    root, other = ours.reset(), expected.reset()
    for _ in range(8):
        action = ours.action_spec.rand()
        step, root = ours.step_and_maybe_reset(root.set("action", action))
        following, other = expected.step_and_maybe_reset(other.set("action", action))
        assert (step == following).all()
        assert (root == other).all()
    ours.close()


SIGNPOST = """
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

gymnasium.register("Signpost-v0", lambda **kwargs: CartPoleEnv(**kwargs))
"""


def test_processes_import_what_registers_the_task(own_modules):
    (own_modules / "signpost.py").write_text(SIGNPOST)
    import_allowed("signpost")
    env = make_env("Signpost-v0", vectorization_mode="async")
    assert env.rollout(3).shape[-1] > 0
    env.close()


def test_processes_that_fail_print_one_line(own_modules, monkeypatch):
    monkeypatch.setattr(gymnasium_tasks.signal, "signal", lambda *_: None)
    with pytest.raises(
        SystemExit, match=r"ValueError: no module .* registers the task 'Signpost-v0'"
    ):
        gymnasium_tasks._task("Signpost-v0", (), -1, False)

    def end(*args, **kwargs):
        raise ConnectionResetError

    monkeypatch.setattr(gymnasium_tasks, "AsyncVectorEnv", end)
    with pytest.raises(ValueError, match="'CartPole-v1' cannot be made in processes of its own"):
        make_env("CartPole-v1", vectorization_mode="async")


def test_older_versions_by_name(recwarn):
    """Without Gymnasium's warning that there is a newer one."""
    assert make_env("Ant-v4").observation_spec["observation"].shape == (1, 27)
    assert not recwarn.list


MESSAGE = "MuJoCo: Nan, Inf or huge value in CTRL"  # at every step with such an action


@pytest.fixture
def handler() -> Iterator[Callable[[Callable[[str], None] | None], None]]:
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    yield mujoco.set_mju_user_warning
    mujoco.set_mju_user_warning(before)


@pytest.mark.usefixtures("handler")
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
