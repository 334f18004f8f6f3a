"""Runs with a checkpoint and an evaluation that took no training: their weights are random."""

from pathlib import Path

import torch

from recipes.core import runner
from recipes.core.algorithm import make_algorithm
from recipes.core.progress import Record
from recipes.core.recipe import Recipe
from recipes.core.run import Run
from recipes.ppo import PPO
from recipes.tools.agents import pack
from torchrl_tit.agents.folder import write_agent
from torchrl_tit.settings.networks import enhanced_tit


def make_run(folder: Path, recipe: Recipe | None = None) -> Path:
    """Makes a run folder, by default PPO's on CartPole with a history of two observations."""
    recipe = recipe or PPO(
        name="ppo/cartpole/small",
        env="CartPole-v1",
        backbone=enhanced_tit(2, patch_size=2, embed_dim=8, num_blocks=1, features_dim=8),
        evaluation_episodes=3,
        evaluation_seed=5,
        env_settings=("max_episode_steps=20",),
    )
    torch.manual_seed(3)
    algorithm = make_algorithm(recipe)
    state = {
        name: torch.rand_like(value) - 0.5 if name.endswith(("bias", "mean")) else value
        for name, value in algorithm.model.state_dict().items()
    }
    run = Run.create(folder, recipe)
    record = Record(recipe, algorithm).state_dict()
    run.save(7, {"networks": state, "record": record})
    run.save_evaluation(runner.evaluate(run))
    return folder


def packed(run: Path, folder: Path) -> Path:
    """Makes an agent of a run."""
    files, steps = pack(run, folder.name)
    write_agent(folder, files, steps)
    return folder
