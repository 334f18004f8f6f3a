"""What agents read of a cue when they decide."""

import json
from dataclasses import replace

import pytest
import torch

from benchmarks import cue_attention
from benchmarks.cue_attention import Decision, main, measure_decisions, to_markdown
from recipes.ppo import PPO
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import enhanced_tit

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


def decide(right, *shares):
    """A decision whose two blocks read so much of the first of four frames, which has the cue."""
    return Decision(right, [[share, 1 - share, 0, 0] for share in shares], [True, *[False] * 3])


def test_right_and_wrong_decisions_have_a_row_each():
    text = to_markdown(
        {"maze": [decide(True, 0.1, 0.7), decide(True, 0.9, 0.1), decide(False, 0.2, 0.2)]}
    )
    assert "| maze | right | 2 | 0.50, 0.40 | 0.80 | 0.25 |" in text
    assert "| maze | wrong | 1 | 0.20, 0.20 | 0.20 | 0.25 |" in text
