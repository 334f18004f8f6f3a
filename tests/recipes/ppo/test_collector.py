"""Environments and collectors in processes of their own."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace

import pytest
import torch
from torch import multiprocessing

from recipes.core.metrics import Metrics
from recipes.core.run import Run
from recipes.core.runner import train
from recipes.core.task import seed_copies
from recipes.ppo import PPOAlgorithm
from tests.numerics import assert_near
from tests.recipes.ppo import tasks
from tests.recipes.small import TINY
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.settings.networks import enhanced_tit

RECIPE = replace(
    TINY,
    backbone=enhanced_tit(2, embed_dim=8, features_dim=8),
    total_steps=192,
    num_envs=4,
    collectors=2,
    minibatch_size=16,
)


@pytest.mark.slow
def test_batches_are_those_of_the_policy(tmp_path, monkeypatch):
    """Of a task with several observations."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)  # in the processes, too
    wrappers = (f"{tasks.__name__}:Split",)
    recipe = replace(RECIPE, reward_scale=1.0, wrappers=wrappers)
    algorithm = PPOAlgorithm(recipe)
    algorithm.prepare(0, tmp_path)
    model, collector = algorithm.model, algorithm.collector
    envs = 4
    starts, continued, count = [], 0, 0
    for batch in algorithm.batches():
        count += 1
        assert batch.shape == (envs, 64 // envs)
        features, first = batch["features"], batch["observation", "pole"][:, 0].tolist()
        histories = algorithm.rollout(batch).histories(torch.arange(64))
        windows = [history.view(*batch.shape, 2, 2) for history in histories]
        poles = windows[1][:, 0]
        continued += int((poles[:, 0] != poles[:, 1]).any(-1).sum())
        with torch.no_grad():
            expected = model.backbone.module(*windows)
        assert_near(features, expected)
        starts += first
        for parameter in model.parameters():
            parameter.data.add_(0.01)
        collector.update_policy_weights_()
    assert continued >= envs  # windows at the start of a batch know the end of the one before
    collector.shutdown()
    assert count * 64 == 192
    one = seed_copies(algorithm.make_env(4), RECIPE.seed)  # all in one process
    assert starts[:envs] == one.reset()["history", "pole"][:, -1].tolist()


@pytest.mark.slow
def test_a_terminals_ctrl_c_reaches_every_process_and_saves(tmp_path, monkeypatch):
    log = Metrics.log

    def ctrl_c(metrics, step, **values):
        log(metrics, step, **values)
        if step == 64:
            for process in multiprocessing.active_children():
                assert process.pid
                os.kill(process.pid, signal.SIGINT)
            time.sleep(1)  # in which they would end
        else:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Metrics, "log", ctrl_c)
    recipe = replace(RECIPE, checkpoint_interval=10**6)
    with Run.create(tmp_path / "run", recipe) as run, pytest.raises(KeyboardInterrupt):
        train(recipe, run)
    assert checkpoint_steps(run.checkpoints) == [128]
