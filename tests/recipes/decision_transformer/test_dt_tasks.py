"""Which tasks Decision Transformer's recipes take, and how long their episodes are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from recipes.decision_transformer import check_data
from tests.datasets.rollouts import roll, write
from tests.recipes.small import (
    SMALL_DT,
    make_algorithm,
    make_dt,
    make_odt,
)
from torchrl_tit.datasets import load_episodes, select_episodes, write_minari
from torchrl_tit.settings.networks import decision_transformer, dt_tit


class Endless(gymnasium.Env[Any, Any]):
    """Never ends by itself."""

    observation_space = Box(-1.0, 1.0, (3,), np.float32)

    def __init__(self, lowest: float = -1.0) -> None:
        self.action_space = Box(np.array([-1.0, lowest], np.float32), np.ones(2, np.float32))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(3, np.float32), 1.0, False, False, {}


gymnasium.register("tests/Endless-v0", lambda **_: Endless())
gymnasium.register("tests/Lopsided-v0", lambda **_: Endless(lowest=0.0), max_episode_steps=10)
gymnasium.register("tests/Long-v0", lambda **_: Endless(), max_episode_steps=30)


def test_a_task_without_a_time_limit_is_cut_off_where_time_steps_end(tmp_path):
    recipe = make_dt(
        tmp_path,
        env="tests/Endless-v0",
        backbone=dt_tit(**SMALL_DT, max_ep_len=12),
        evaluation_episodes=2,
    )
    assert [outcome.returns for outcome in make_algorithm(recipe).play(0)] == [[12, 12]] * 2


def test_episodes_that_are_explored_are_as_long_as_those_of_the_evaluation(tmp_path):
    """Without an embedding of time steps nothing ends at max_ep_len but endless tasks."""
    backbone = dt_tit(**SMALL_DT, max_ep_len=12, timestep_embedding=False)
    for env, length in {"tests/Endless-v0": 12, "tests/Long-v0": 30}.items():
        recipe = make_odt(tmp_path, env=env, backbone=backbone, evaluation_episodes=1)
        algorithm = make_algorithm(recipe)
        episodes = algorithm.explore(0)
        assert episodes.lengths.tolist() == algorithm.play(0)[0].returns == [length]
        assert episodes.truncated.all()


def test_every_entry_of_an_action_must_reach_as_far_as_the_heads(tmp_path):
    with pytest.raises(ValueError, match="actions of tests/Lopsided-v0 range from 0 to 1, but"):
        make_algorithm(make_dt(tmp_path, env="tests/Lopsided-v0"))


def test_whole_atari_games_need_as_many_time_steps(tmp_path):
    pytest.importorskip("ale_py")
    settings: dict[str, Any] = {"env": "ALE/Pong-v5", "action_space": "discrete"}
    recipe = make_dt(tmp_path, backbone=dt_tit(**SMALL_DT, patch_size=42), **settings)
    with pytest.raises(ValueError, match="Pong-v5 have up to 27000 steps, but max_ep_len is 1000"):
        make_algorithm(recipe)
    backbone = dt_tit(**SMALL_DT, patch_size=42, max_ep_len=27_000)
    algorithm = make_algorithm(make_dt(tmp_path, backbone=backbone, **settings))
    state = algorithm.make_env(2).reset()
    assert algorithm.policy(state)["action"].shape == (2,)


def test_only_episodes_that_are_trained_on_must_be_short(tmp_path):
    """The last one, which the data break off in, is left out."""
    arrays = roll(max_episode_steps=15)
    arrays["terminals"][-40:] = arrays["timeouts"][-40:] = False
    arrays["next_observations"][-41:-1] = arrays["observations"][-40:]
    path = str(write(tmp_path / "broken_off.hdf5", arrays))
    recipe = make_dt(tmp_path, backbone=decision_transformer(5, max_ep_len=15))
    episodes = load_episodes(path, task="Hopper-v5")
    check_data(recipe, episodes)
    assert episodes.lengths.max() > 15

    last = torch.tensor([len(episodes.lengths) - 1])
    write_minari(select_episodes(episodes, last), folder := tmp_path / "hopper-v0")
    with pytest.raises(ValueError, match=r"no episode in .*hopper-v0 is finished"):
        check_data(
            replace(recipe, dataset=str(folder)), load_episodes(str(folder), task="Hopper-v5")
        )
