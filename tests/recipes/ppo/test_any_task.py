"""Recipes for any task: the frame encoders follow from its observations."""

from dataclasses import replace

import pytest

from recipes.cli import main, training
from recipes.core.algorithm import make_algorithm
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import get_recipe
from recipes.core.run import Run
from tests.recipes.ppo import tasks
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings import Inner, Linear
from torchrl_tit.settings.networks import enhanced_tit

TASK = next(f"{name}Actions-v0" for name in tasks.ACTIONS)
NAMES = ["ppo/enhanced-tit", "ppo/vanilla-tit", "ppo/mlp", "ppo/lstm"]


@pytest.mark.parametrize("env", [TASK, "FrozenLake-v1"])
@pytest.mark.parametrize("name", NAMES)
def test_the_name_of_a_task_is_enough(name, env):
    make_algorithm(replace(get_recipe(name), env=env)).check()


def test_what_was_chosen_is_printed_and_recorded(monkeypatch, tmp_path, capsys):
    runs: list[Run] = []
    monkeypatch.setattr(training, "_finish", lambda run, *_: runs.append(run))
    words = ["--env", TASK, "--backbone.frames.state/0", "linear", "--out", str(tmp_path / "run")]
    main(["train", "ppo/mlp", *words, "--backbone.frames.state/0.embed-dim", "8"])
    assert capsys.readouterr().out == (
        "frames chosen by kind of observation: image: inner (patch_size auto, embed_dim 8, "
        "every_block False); state/1: linear (embed_dim 8, bias True)\n"
    )
    (run,) = runs
    frames = {
        "image": Inner(embed_dim=8, patch_size="auto", every_block=False),
        "state/0": Linear(embed_dim=8),
        "state/1": Linear(embed_dim=8, bias=True),
    }
    assert run.recipe.backbone.frames == frames
    recipe = recipe_from_json((tmp_path / "run" / "recipe.json").read_text(), "it")
    assert recipe == run.recipe
    modules = make_algorithm(recipe).policy.modules()
    network = next(module for module in modules if isinstance(module, HistoryNetwork))
    assert network.frame_settings == frames


def test_recipes_with_frames_have_a_hash_and_json():
    recipe = get_recipe("ppo/enhanced-tit")
    frames = {"image": Inner(patch_size="auto"), "arm/left": Linear()}
    named = replace(recipe, backbone=replace(enhanced_tit(), frames=frames))
    same = replace(recipe, backbone=replace(enhanced_tit(), frames=dict(reversed(frames.items()))))
    assert named == same
    assert len({recipe: 1, named: 2, same: 3}) == 2
    assert recipe_from_json(recipe_to_json(named), "it") == named
