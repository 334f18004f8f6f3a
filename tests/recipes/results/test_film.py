"""Films of trained agents."""

from functools import partial

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from recipes.cli import main
from recipes.core.algorithm import make_algorithm
from recipes.core.numbers import plus_minus
from recipes.core.runner import load_trained
from recipes.ppo import PPO
from recipes.tools.results.film import film_policy
from tests.recipes.commands import fails
from tests.recipes.untrained import untrained
from torchrl_tit.evaluation import evaluate
from torchrl_tit.settings.networks import enhanced_tit, mlp


def durations(film):
    """Milliseconds for which each picture is shown."""
    with Image.open(film) as file:
        return [picture.info["duration"] for picture in ImageSequence.Iterator(file)]


SHORT = PPO(env="CartPole-v1", env_settings=("max_episode_steps=9",), backbone=mlp())


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    return untrained(tmp_path_factory.mktemp("run"), SHORT)


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_one_picture_a_step_and_one_of_each_end(cartpole, tmp_path, capsys, suffix):
    pytest.importorskip("pygame")
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    film = tmp_path / f"film{suffix}"
    main(["play", str(cartpole.folder), "--out", str(film), "--episodes", "2", "--seed", "5"])
    _, algorithm, _ = load_trained(cartpole)
    returns = evaluate(algorithm.make_env, algorithm.policy, 2, seed=5)
    returned = plus_minus(returns.mean().item(), returns.std(correction=0).item())
    assert f"return {returned} over 2 episodes" in capsys.readouterr().out
    pictures = imageio.imread(film)
    assert pictures.shape[1:] == (400, 600, 3)
    if suffix == ".gif":  # where two pictures are the same, one is shown for longer
        assert sum(durations(film)) == 20 * (returns.sum() + 2)  # milliseconds, at 50 a second
    else:
        assert len(pictures) == returns.sum() + 2
    assert (pictures[0] != pictures[-1]).any()
    assert [path.name for path in tmp_path.iterdir()] == [film.name]


def test_the_end_is_shown(tmp_path):
    """In a T-Maze, the last step is the turn."""
    recipe = PPO(env="TMaze-v0", env_settings=("corridor_length=3",), backbone=mlp())
    algorithm = make_algorithm(recipe)
    walk = iter([0, 0, 0, 1] * 2)

    def policy(tensordict):
        return tensordict.set("action", torch.full(tensordict.shape, next(walk)))

    film_policy(algorithm.make_env, policy, "it", tmp_path / "film.gif")
    *before, last = imageio.imread(tmp_path / "film.gif")
    assert len(before) == 4
    agent = [np.argwhere((picture == (200, 0, 0)).all(-1)).mean(0) // 8 for picture in before]
    assert [place.tolist() for place in agent] == [[2, x] for x in (1, 2, 3, 4)]
    assert ((last == (200, 0, 0)).all(-1).nonzero()[0] // 8 == 1).all()


def test_atari(tmp_path):
    pytest.importorskip("ale_py")
    backbone = enhanced_tit(2, patch_size=42, embed_dim=8, num_blocks=1, features_dim=8)
    recipe = PPO(env="ALE/Breakout-v5", num_envs=2, backbone=backbone)
    algorithm = make_algorithm(recipe)
    # Only the start, as a game can be long where an agent does nothing.
    make_env = partial(algorithm.make_env, max_num_frames_per_episode=400)
    film_policy(make_env, algorithm.policy, "it", tmp_path / "film.gif", max_pictures=30)
    pictures = imageio.imread(tmp_path / "film.gif")
    assert len(pictures) <= 30
    assert pictures.shape[1:] == (210, 160, 3)
    assert (pictures[0] != pictures[-1]).any()


def test_pictures_that_cannot_be_drawn(cartpole, tmp_path, capsys, monkeypatch):
    class FatalError(Exception):
        """As MuJoCo raises it where there is no screen."""

    def fail(self):
        raise FatalError("OpenGL has not been loaded")

    monkeypatch.setattr("torchrl_tit.envs.GymVectorEnv.render", fail)
    error = fails(capsys, "play", cartpole.folder, "--out", tmp_path / "film.gif")
    assert "cannot be rendered: OpenGL has not been loaded; for MuJoCo without a screen" in error
    assert "MUJOCO_GL to egl" in error
    assert not any(tmp_path.iterdir())
