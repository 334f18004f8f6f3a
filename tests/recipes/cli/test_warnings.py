"""Warnings and hints on the command line."""

from __future__ import annotations

import warnings

import recipes
from recipes.cli.arguments import one_line_warnings
from tests.recipes.commands import Command


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
