"""SAC on a task with several observations: an image and an array."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.core.run import Run
from recipes.core.runner import evaluate, train
from recipes.sac import SAC
from torchrl_tit.settings.networks import enhanced_tit

NAME = "ImageAndArray-v0"


class ImageAndArray(gymnasium.Env):
    """Random observations; the reward is the action."""

    observation_space = Dict(
        {"image": Box(0, 255, (6, 6), np.uint8), "array": Box(-1, 1, (2,), np.float32)}
    )
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        ended = bool(self.np_random.random() < 0.2)
        return self._observe(), float(action[0]), ended, False, {}

    def _observe(self) -> dict[str, Any]:
        return {
            "image": self.np_random.integers(0, 256, (6, 6), np.uint8),
            "array": self.np_random.random(2, np.float32),
        }


@pytest.fixture
def task() -> Iterator[str]:
    gymnasium.register(NAME, entry_point=lambda **_: ImageAndArray())
    yield NAME
    del gymnasium.registry[NAME]


@pytest.mark.parametrize("slice_length", [1, 2])
def test_trains(slice_length: int, task: str, tmp_path: Path) -> None:
    recipe = SAC(
        name="sac/several",
        env=task,
        backbone=enhanced_tit(2, patch_size=3, embed_dim=8, num_blocks=1, features_dim=8),
        critic="backbone",
        critic_hidden=(8,),
        slice_length=slice_length,
        batch_size=8,
        random_steps=10,
        steps_per_batch=10,
        total_steps=30,
        updates_per_step=0.2,
        log_interval=10,
        evaluation_episodes=1,
    )
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
        assert evaluate(run)["episodes"] == 1
    assert np.isfinite(read_metrics(run.folder / "metrics.csv")[-1]["loss_qvalue"])
    message = r"an MLP cannot value several observations \(array, image\): set critic to 'backbone'"
    with pytest.raises(ValueError, match=message):
        make_algorithm(replace(recipe, critic="mlp"))
