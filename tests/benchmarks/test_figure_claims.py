"""The paper's claims about its pictures, measured on runs."""

import json
import math
from dataclasses import replace
from typing import Any

import pytest

from benchmarks.figure_claims import FigureClaims, main, measure_figure_claims, to_markdown
from recipes.ppo import PPO
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import enhanced_tit, resnet

TIT: dict[str, Any] = {"patch_size": 8, "embed_dim": 8, "num_blocks": 1, "features_dim": 8}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    pytest.importorskip("minigrid")
    folder = tmp_path_factory.mktemp("runs")
    recipe = PPO(
        name="tit",
        env="MiniGrid-Empty-5x5-v0",
        env_settings=("max_episode_steps=6",),
        wrappers=(
            "minigrid.wrappers:RGBImgObsWrapper(tile_size=8)",
            "minigrid.wrappers:ImgObsWrapper",
        ),
        backbone=enhanced_tit(3, **TIT),
        initialization="orthogonal",
    )
    cnn = replace(recipe, name="resnet", backbone=resnet(3, features_dim=8))
    recipes = [recipe, replace(recipe, seed=1), cnn]
    return [untrained(folder / str(i), made) for i, made in enumerate(recipes)]


def raised(outputs):
    return outputs["state_value"]


def lowered(outputs):
    return -outputs["state_value"]


@pytest.mark.parametrize("index", [0, 2])
def test_measured(runs, index):
    # Without training a map can be 0 everywhere; then what lowers the value is not.
    # Agents may stand still, so objects are what has another color than the walls.
    found = [
        measure_figure_claims(runs[index], steps=14, target=target, background="color")
        for target in (raised, lowered)
    ]
    claims = min(found, key=lambda claims: claims.empty_maps)
    assert claims.empty_maps < 1
    assert 0 < claims.area_of_objects < 0.9
    assert 0 <= claims.share_on_objects <= 1
    assert 0 <= claims.change <= 1
    assert 0 <= claims.change_of_any <= 1
    if index == 0:
        assert claims.attention is not None
        assert len(claims.attention) == 3
        assert math.isclose(sum(claims.attention), 1, rel_tol=1e-5)
    else:
        assert claims.attention is None


def test_command(runs, tmp_path, capsys):
    main([*(str(run.folder) for run in runs), "--steps", "4", "--out", str(tmp_path)])
    written = json.loads((tmp_path / "figure_claims.json").read_text())
    assert {name: len(found) for name, found in written["runs"].items()} == {"tit": 2, "resnet": 1}
    text = (tmp_path / "figure_claims.md").read_text()
    assert text in capsys.readouterr().out
    assert "| tit | 2 | " in text
    assert "Measured with `python -m benchmarks.figure_claims RUN ... --steps 4`" in text


def claims(share, attention):
    return FigureClaims(share, 0.1, 0.2, 0.3, 0.0, attention)


def test_tables():
    groups = {
        "tit": [claims(0.5, [0.3, 0.1, 0.6]), claims(0.7, [0.5, 0.1, 0.4])],
        "cnn": [claims(0.25, None)],
    }
    maps, attention = to_markdown(groups).split("\n\n")
    assert "| tit | 2 | 0.6 | 0.1 | 0.2 | 0.3 | 0 |" in maps
    assert "| cnn | 1 | 0.25 | 0.1 | 0.2 | 0.3 | 0 |" in maps
    assert attention.splitlines()[0] == "| recipe | runs | -2 steps | -1 steps | newest |"
    assert "| tit | 2 | 0.4 | 0.1 | 0.5 |" in attention
    assert "cnn" not in attention
