"""The hint that a network reads more frames than episodes have."""

import warnings

import pytest
import torch
from tensordict import TensorDict

from recipes.cli.unused_frames import UnusedFrames
from recipes.ppo import PPO
from tests.recipes.commands import Command
from torchrl_tit.settings.networks import enhanced_tit


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


def test_on_the_command_line(tmp_path):
    errors = tmp_path / "errors"
    words = ["train", "ppo/tmaze-10/enhanced-tit", "--out", tmp_path / "run", "--compile", "off"]
    words += ["--total-steps", 2048, "--epochs", 1]
    words += ["--evaluation-episodes", 1]
    assert Command([*words, "--backbone.num-frames", 12], errors).wait() == 0
    assert errors.read_text().count("warning: num_frames is 12, but no episode so far had") == 1
