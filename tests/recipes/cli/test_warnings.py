"""Warnings and hints on the command line."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import TensorDict

import recipes
from recipes.cli.arguments import one_line_warnings
from recipes.cli.training import UnusedFrames
from recipes.ppo import PPO
from tests.recipes.commands import Command
from torchrl_tit.settings.networks import enhanced_tit


def test_each_stands_in_one_line_once():
    pythons = warnings.formatwarning
    with one_line_warnings():
        written = [
            warnings.formatwarning(f"a library\nsays {number}", UserWarning, "lib.py", 7)
            for number in (1, 2, 1)
        ]
        ours = warnings.formatwarning("no such return", UserWarning, recipes.__file__, 7)
    assert written == [
        "warning: a library says 1 (lib.py:7)\n",
        "warning: a library says 2 (lib.py:7)\n",
        "",
    ]
    assert ours == "warning: no such return\n"
    assert warnings.formatwarning is pythons


def test_commands_warn_in_one_line(tmp_path):
    """A task whose texts are left out, which each of its copies would say."""
    errors = tmp_path / "errors"
    words = ["train", "ppo/mlp", "--env", "MiniGrid-Empty-5x5-v0", "--out", tmp_path / "run"]
    words += ["--total-steps", 64, "--steps-per-batch", 64, "--minibatch-size", 32, "--num-envs", 1]
    words += ["--epochs", 1, "--evaluation-episodes", 1, "--compile", "off"]
    assert Command(words, errors).wait() == 0
    warned = [line for line in errors.read_text().splitlines() if "arning" in line]
    assert len(warned) == 1, warned
    assert warned[0].startswith("warning: The observation 'mission' (MissionSpace")


def test_a_film_without_a_screen_says_nothing(tmp_path):
    """Neither SDL, which draws CartPole, nor another library: only how far it is."""
    errors = tmp_path / "errors"
    words = ["explain", "cartpole", "--out", tmp_path / "film.gif", "--max-steps", "2"]
    assert Command(words, errors).wait() == 0
    assert "rror" not in errors.read_text()
    assert "arning" not in errors.read_text()


def batches(length: int, num_envs: int = 2, steps: int = 64):
    """Batches of 64 steps, in which every episode is as long."""
    done = torch.arange(1, 10_000) % length == 0
    for part in done.split(steps):
        yield TensorDict({"next": {"done": part.expand(num_envs, -1)[..., None]}}, [num_envs])


def watch(num_frames: int, length: int, total_steps: int = 12_800) -> list[str]:
    """What is said in a run whose episodes are as long."""
    recipe = PPO(
        name="r", env="CartPole-v1", backbone=enhanced_tit(num_frames), total_steps=total_steps
    )
    hint, step = UnusedFrames(recipe), 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for batch in batches(length):
            step += 128
            hint.collected(step, batch)
    return [str(warning.message) for warning in caught]


def test_episodes_shorter_than_the_history_are_named_once():
    [message] = watch(num_frames=12, length=11)
    assert message == (
        "num_frames is 12, but no episode so far had more than 11 steps: with num_frames 11 the "
        "network sees as much, and trains faster"
    )


@pytest.mark.parametrize(
    ("num_frames", "length"),
    [
        (11, 11),
        (1, 1),
        (65, 66),  # longer than a batch
        (300, 200),  # too few episodes to judge by
    ],
)
def test_others_are_not(num_frames, length):
    assert watch(num_frames, length) == []
