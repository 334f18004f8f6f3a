"""Scripted episodes of MiniGrid-Memory, and what is learned from them."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("minigrid")

from benchmarks import image_scale
from recipes.presets.ppo_memory import memory_networks


@pytest.fixture(scope="module")
def episodes() -> image_scale.Episodes:
    return image_scale.Episodes(400)


def test_a_transformer_learns_from_normalized_pixels(episodes: image_scale.Episodes) -> None:
    torch.manual_seed(0)
    network = memory_networks(image_scale.NUM_FRAMES, patch_size=8)["enhanced-tit"]
    steps, accuracy = image_scale.gradient_steps(
        network,
        image_scale.PIXELS["normalised by pixel"],
        episodes,
        seed=1,
        limit=400,
        held_out=128,
    )
    assert accuracy >= 0.97, f"{accuracy} after {steps} steps"


def test_a_row_for_each_network_scale_and_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, episodes: image_scale.Episodes
) -> None:
    def few(*arguments: Any, **settings: Any) -> tuple[int, float]:
        return learned(*arguments, **settings, limit=1, held_out=100)

    learned = image_scale.gradient_steps
    monkeypatch.setattr(image_scale, "Episodes", lambda count: episodes)
    monkeypatch.setattr(image_scale, "gradient_steps", few)
    out = tmp_path / "rows" / "scale.csv"
    image_scale.main(["--seeds", "3", "--out", str(out)])
    rows = list(csv.DictReader(out.open(encoding="utf-8")))
    assert len(rows) == 3 * len(image_scale.PIXELS)
    assert {(row["seed"], row["gradient_steps"]) for row in rows} == {("3", "1")}
