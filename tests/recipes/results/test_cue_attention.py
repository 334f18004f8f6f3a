"""What agents read of a cue when they decide."""

import json
from dataclasses import replace

import pytest
import torch

from benchmarks.cue_attention import main
from recipes.ppo import PPO
from recipes.results import cue_attention
from recipes.results.cue_attention import Decision, measure_decisions, to_markdown
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import enhanced_tit, mlp

RECIPE = PPO(
    name="maze",
    env="TMaze-v0",
    env_settings=("corridor_length=3",),
    backbone=enhanced_tit(4, embed_dim=8, features_dim=8, temporal_positions="learned"),
)


def marked(shares):
    """Attention that reads so much of each of the K steps, the same in both blocks."""
    return lambda network, history: torch.tensor(shares).expand(1, 2, 1, -1)


@pytest.mark.parametrize(
    ("num_frames", "shares", "read", "even"),
    [
        (4, [0.4, 0.3, 0.2, 0.1], 0.4, 1 / 4),
        (6, [0.1, 0.1, 0.3, 0.2, 0.2, 0.1], 0.5, 3 / 6),  # two copies of the cue before it
        (3, [0.5, 0.3, 0.2], 0.0, 0.0),  # the cue is out of reach
    ],
)
def test_the_frames_that_show_the_cue_are_counted(
    tmp_path, monkeypatch, num_frames, shares, read, even
):
    monkeypatch.setattr(cue_attention, "outer_attention", marked(shares))
    recipe = replace(RECIPE, backbone=replace(RECIPE.backbone, num_frames=num_frames))
    for decision in measure_decisions(untrained(tmp_path / "run", recipe), episodes=3):
        assert decision.shares == pytest.approx([read, read])
        assert decision.even == pytest.approx(even)
        assert not decision.right  # it has not learned to walk


def test_the_command_writes_what_it_prints(tmp_path, capsys):
    run = untrained(tmp_path / "run", RECIPE)
    main([str(run.folder), "--episodes", "2", "--out", str(tmp_path / "out")])
    assert "| maze, seed 0 | wrong | 2 | " in capsys.readouterr().out
    numbers = json.loads((tmp_path / "out" / "cue_attention.json").read_text())["runs"]
    for decision in numbers["maze, seed 0"]:
        assert all(0 < share < 1 for share in decision["shares"])


def test_two_runs_of_one_recipe_and_seed_have_a_row_each(tmp_path, capsys):
    runs = [untrained(tmp_path / name, RECIPE) for name in ("a", "b")]
    main([*(str(run.folder) for run in runs), "--episodes", "1"])
    printed = capsys.readouterr().out
    assert "| maze, seed 0 | wrong | 1 | " in printed
    assert f"| maze, seed 0 ({runs[1].folder}) | wrong | 1 | " in printed


def test_right_and_wrong_decisions_have_a_row_each():
    right = [Decision(True, [0.1, 0.7], 0.25), Decision(True, [0.9, 0.1], 0.25)]
    text = to_markdown({"maze": [*right, Decision(False, [0.2, 0.2], 0.25)]})
    assert "| maze | right | 2 | 0.50, 0.40 | 0.80 | 0.25 |" in text
    assert "| maze | wrong | 1 | 0.20, 0.20 | 0.20 | 0.25 |" in text


def test_bad_input(tmp_path, capsys):
    def error(*words):
        with pytest.raises(SystemExit):
            main([str(word) for word in words])
        return capsys.readouterr().err

    run = untrained(tmp_path / "run", RECIPE)
    assert "episodes must be at least 1, not 0" in error(run.folder, "--episodes", 0)
    zeros = untrained(tmp_path / "zeros", replace(RECIPE, padding="constant"))
    assert "histories begin with zeros, not with the cue" in error(zeros.folder)
    other = untrained(tmp_path / "mlp", replace(RECIPE, backbone=mlp()))
    assert "has no attention over time" in error(other.folder)
    assert "is not a run folder" in error(tmp_path)
