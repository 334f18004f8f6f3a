"""What agents read of a cue when they decide."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import cue_attention
from benchmarks.cue_attention import (
    Decision,
    main,
    measure_decisions,
    plot_decisions,
    to_markdown,
)
from recipes.core.registry import get_recipe
from recipes.ppo import PPO
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
        assert (decision["right"], decision["even"]) == (False, 0.25)
        assert all(0 < share < 1 for share in decision["shares"])
    assert (tmp_path / "out" / "cue_attention.png").read_bytes().startswith(b"\x89PNG")


def test_two_runs_of_one_recipe_and_seed_have_a_row_each(tmp_path, capsys):
    runs = [untrained(tmp_path / name, RECIPE) for name in ("a", "b")]
    main([*(str(run.folder) for run in runs), "--episodes", "1"])
    printed = capsys.readouterr().out
    assert "| maze, seed 0 | wrong | 1 | " in printed
    assert f"| maze, seed 0 ({runs[1].folder}) | wrong | 1 | " in printed


def decide(right, *shares):
    """A decision whose two blocks read so much of the first of four frames, which has the cue."""
    return Decision(right, [[share, 1 - share, 0, 0] for share in shares], [True, *[False] * 3])


def test_right_and_wrong_decisions_have_a_row_each():
    text = to_markdown(
        {"maze": [decide(True, 0.1, 0.7), decide(True, 0.9, 0.1), decide(False, 0.2, 0.2)]}
    )
    assert "| maze | right | 2 | 0.50, 0.40 | 0.80 | 0.25 |" in text
    assert "| maze | wrong | 1 | 0.20, 0.20 | 0.20 | 0.25 |" in text


def test_in_minigrid_the_frames_where_the_object_is_in_view_count(tmp_path, monkeypatch):
    pytest.importorskip("minigrid")
    seen = iter([False, True, False, True, True, False, False, False])

    def agent_sees(env, x, y):
        assert env.grid.get(x, y).type in ("ball", "key")
        return next(seen)

    monkeypatch.setattr("minigrid.minigrid_env.MiniGridEnv.agent_sees", agent_sees)
    recipe = replace(
        get_recipe("ppo/memory-s7/enhanced-tit"),
        env_settings=("agent_view_size=3", "max_episode_steps=8"),
        backbone=enhanced_tit(6, embed_dim=8, features_dim=8, patch_size=8),
    )
    monkeypatch.setattr(cue_attention, "outer_attention", marked([0.1, 0.1, 0.3, 0.2, 0.2, 0.1]))
    [decision] = measure_decisions(untrained(tmp_path / "run", recipe), episodes=1)
    assert decision.cue == [False, True, True, False, False, False]
    assert decision.shares == pytest.approx([0.4, 0.4])
    assert decision.even == pytest.approx(2 / 6)


def test_the_picture_has_right_decisions_above_wrong_ones_and_marks_the_cue():
    decisions = [decide(False, 0.1, 0.3), decide(True, 0.9, 0.2)]
    [panel, other] = plot_decisions({"one": decisions, "two": decisions[1:]}).axes[:2]
    assert np.allclose(
        np.asarray(panel.images[0].get_array()), [[0.9, 0.1, 0, 0], [0.3, 0.7, 0, 0]]
    )
    assert np.array_equal(panel.collections[0].get_offsets(), [[-3, 0.5], [-3, 1.5]])
    [line] = panel.lines
    assert line.get_ydata() == [1, 1]
    assert not other.lines


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
