"""Networks that are put together on the command line."""

import json
from dataclasses import fields, replace
from typing import Any

from recipes.cli import main
from recipes.cli.backbone_options import choose_network
from recipes.core.registry import get_recipe
from tests.recipes.cli.test_cli import SHORT
from torchrl_tit.settings import (
    NETWORKS,
    Flat,
    FrameSettings,
    HistorySettings,
    Inner,
    Linear,
    NatureCNNFrames,
    Outer,
    PairedOuter,
    ResNetFrames,
)
from torchrl_tit.settings.networks import catformer

PONG = get_recipe("ppo/pong/enhanced-tit")
CARTPOLE = get_recipe("ppo/cartpole/enhanced-tit")


def choose(recipe: Any, words: list[str]) -> Any:
    chosen, _ = choose_network(recipe, words)
    return chosen


def test_a_pair_takes_over_what_the_recipe_chose():
    chosen = ["--backbone.frame", "resnet", "--backbone.history=outer", "--num-envs", "4"]
    recipe = choose(PONG, chosen)
    assert recipe.backbone.frame == ResNetFrames(embed_dim=64)
    paired = PONG.backbone.history
    assert isinstance(paired, PairedOuter)
    shared = {field.name: getattr(paired, field.name) for field in fields(paired)}
    assert recipe.backbone.history == Outer(**shared)
    assert recipe.backbone.head == PONG.backbone.head
    assert recipe.backbone.num_frames == 4
    assert replace(recipe, backbone=PONG.backbone) == PONG  # the rest is read later


def test_defaults_and_fields_of_another_type_are_not_taken_over():
    lstm = get_recipe("ppo/cartpole-no-velocity/lstm")  # a tanh layer of 64
    assert choose(lstm, ["--backbone.frame", "inner"]).backbone.frame == Inner(embed_dim=64)
    mlp = get_recipe("ppo/cartpole/mlp")
    assert choose(mlp, ["--backbone.history", "outer"]).backbone.history == Outer()


def test_a_network_by_name_reads_as_many_frames_as_before():
    assert choose(PONG, ["--backbone.network", "catformer"]).backbone == catformer(4)
    both = ["--backbone.frame", "flat", "--backbone.network", "catformer"]  # in any order
    assert choose(PONG, both).backbone == replace(catformer(4), frame=Flat())


def test_one_of_several_observations():
    words = ["--backbone.frames.image", "nature-cnn", "--backbone.frames.arm/left=linear"]
    backbone = choose(PONG, words).backbone
    # The widths of tokens are the same.
    expected = {"image": NatureCNNFrames(embed_dim=64), "arm/left": Linear(embed_dim=64)}
    assert backbone.frames == expected
    assert replace(backbone, frames={}) == PONG.backbone
    again = replace(PONG, backbone=backbone)
    assert choose(again, ["--backbone.frames.image=inner"]).backbone.frames == {
        **expected, "image": Inner(embed_dim=64)
    }  # fmt: skip
    only_a_field = choose(PONG, ["--backbone.frames.image.patch-size", "3"])
    assert only_a_field.backbone.frames == {"image": PONG.backbone.frame}


def test_fields_of_one_of_several_observations(monkeypatch, capsys):
    monkeypatch.setattr("recipes.cli.training.start", lambda recipe, *_: print(recipe.backbone))
    words = ["--backbone.frames.image", "inner", "--backbone.frames.image.patch-size", "7"]
    words += ["--backbone.frames.arm/left_x.patch-size", "auto"]
    main(["train", "ppo/pong/enhanced-tit", *words])
    frame = PONG.backbone.frame
    assert isinstance(frame, Inner)
    frames = {
        "image": replace(frame, patch_size=7),
        "arm/left_x": replace(frame, patch_size="auto"),
    }
    assert repr(replace(PONG.backbone, frames=frames)) in capsys.readouterr().out


def test_every_name_is_a_choice():
    for name in NETWORKS:
        assert choose(PONG, ["--backbone.network", name]).backbone.num_frames == 4
    for name, part in FrameSettings.registered.items():
        assert type(choose(PONG, ["--backbone.frame", name]).backbone.frame) is part
    for name, part in HistorySettings.registered.items():
        assert type(choose(PONG, ["--backbone.history", name]).backbone.history) is part


def test_a_pair_trains_and_resumes(tmp_path, capsys):
    words = ["ppo/cartpole/mlp", "--out", str(tmp_path / "run"), "--backbone.num-frames", "3"]
    pair = ["--backbone.frame", "linear", "--backbone.frame.embed-dim", "8"]
    pair += ["--backbone.history", "outer", "--backbone.history.num-blocks", "1"]
    main(["train", *words, *pair, *SHORT])
    backbone = json.loads((tmp_path / "run" / "recipe.json").read_text())["backbone"]
    assert (backbone["frame"]["encoder"], backbone["frame"]["embed_dim"]) == ("linear", 8)
    assert (backbone["history"]["encoder"], backbone["history"]["num_blocks"]) == ("outer", 1)
    assert backbone["num_frames"] == 3
    main(["evaluate", str(tmp_path / "run")])
    assert "after 64 steps" in capsys.readouterr().out


def test_what_only_fits_with_a_later_option(tmp_path, monkeypatch, capsys):
    """CoBERL needs several frames."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("recipes.cli.training.start", lambda recipe, *_: print(recipe.backbone))
    coberl = ["--backbone.network", "coberl", "--backbone.num-frames", "2"]
    main(["train", "ppo/cartpole/mlp", *coberl])
    assert "CoBERL(" in capsys.readouterr().out
