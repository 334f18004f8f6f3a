"""Tasks of every kind are trained, evaluated, resumed and rendered from the command line."""

from dataclasses import replace
from typing import Any

import imageio.v3 as imageio
import pytest
import torch

from recipes.cli import main
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.run import Run
from recipes.core.task import make_task, task_limit
from recipes.cql import DiscreteCQL
from recipes.ppo import PPO
from recipes.sac import SAC
from torchrl_tit.settings.networks import mlp

BATCH = 32
OPTIONS = [
    *("train", "ppo/cartpole/enhanced-tit"),
    *("--total-steps", 2 * BATCH, "--steps-per-batch", BATCH, "--minibatch-size", 16),
    *("--num-envs", 2, "--epochs", 1, "--checkpoint-interval", BATCH),
    *("--evaluation-episodes", 2, "--backbone.num-frames", 2, "--backbone.frame.embed-dim", 8),
    *("--backbone.frame.num-blocks", 1, "--backbone.head.features-dim", 8),
]
SHORT = "max_episode_steps=12"
TASKS = {
    "minigrid": [
        *("--env", "MiniGrid-Empty-5x5-v0", "--env-settings", SHORT),
        *("--wrappers", "minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=2)"),
        *("--observation-keys", "image", "direction"),
    ],
    "frozen-lake": ["--env", "FrozenLake-v1", "--env-settings", SHORT, "is_slippery=False"],
    "taxi": ["--env", "Taxi-v4", "--env-settings", SHORT, "--mask-actions"],
    "repeat-previous": ["--env", "popgym-RepeatPreviousEasy-v0", "--env-settings", SHORT],
    # Pixels, numbers, categories; several discrete actions, with masks.
    "robot": [
        *("--env", "tests.envs.tasks:Robot-v0", "--env-settings", SHORT, "--mask-actions"),
        *("--observation-keys", "arm", "camera", "contacts", "wheels"),
    ],
    # TorchRL's own, with transforms.
    "corridor": [
        *("--env", "tests.envs.tasks:Corridor", "--env-settings", SHORT, "half=2"),
        *("--wrappers", "torchrl.envs:RewardScaling(loc=1.0, scale=2.0)"),
    ],
}


@pytest.mark.parametrize("name", TASKS)
def test_trains_evaluates_and_renders(name, tmp_path, capsys):
    needed = {"minigrid": ["minigrid", "pygame"], "repeat-previous": ["popgym"]}
    for module in needed.get(name, ["pygame"]):
        pytest.importorskip(module)
    main([str(word) for word in [*OPTIONS, *TASKS[name], "--out", tmp_path / "whole"]])
    whole = Run.open(tmp_path / "whole")
    capsys.readouterr()
    main(["evaluate", str(whole.folder)])
    assert "2 episodes" in capsys.readouterr().out
    film = tmp_path / "film.gif"
    film_it = ["play", str(whole.folder), "--out", str(film)]
    if name == "repeat-previous":
        with pytest.raises(SystemExit):
            main(film_it)
        assert "cannot be rendered: Task 'popgym" in capsys.readouterr().err
    else:
        main(film_it)
        assert imageio.imread(film).shape[-1] == 3


def test_settings_for_every_algorithm():
    scaled = "torchrl.envs:ObservationNorm(loc=0.0, scale=2.0, in_keys=['observation'])"
    settings: Any = {
        "env": "CartPole-v1",
        "backbone": mlp(),
        "env_settings": (SHORT,),
        "wrappers": (scaled,),
    }
    for recipe in (PPO(**settings), SAC(**settings), DiscreteCQL(dataset="none", **settings)):
        assert hash(recipe) == hash(recipe_from_json(recipe_to_json(recipe), "here"))
        env = make_task(recipe, 2, seed=0)
        plain = make_task(replace(recipe, wrappers=()), 2, seed=0)
        assert torch.equal(env.reset(seed=1)["history"], 2 * plain.reset(seed=1)["history"])
        assert task_limit(recipe) == 12
        assert env.rollout(20)["next", "truncated"].shape[1] <= 12
