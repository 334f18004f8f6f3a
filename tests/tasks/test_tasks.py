"""The passive T-Maze, MinAtar's games, and tasks with fewer actions."""

import re
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Discrete
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common import env_checker

from torchrl_tit.tasks import FirstActions, TMaze

RIGHT, UP, LEFT, DOWN = range(4)


def play(env, seed, actions):
    """Plays actions, or until the end: the observations, and the rewards."""
    observation, _ = env.reset(seed=seed)
    observations, rewards, over = [observation], [], False
    for action in actions:
        assert not over
        observation, reward, over, truncated, _ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        assert not truncated
    assert over
    return np.array(observations), rewards


def turn(cue):
    return UP if cue > 0 else DOWN


@pytest.mark.parametrize("length", [1, 2, 10])
def test_whoever_remembers_gets_1(length):
    env = TMaze(length)
    cues = []
    for seed in range(20):
        cue = env.reset(seed=seed)[0][1]
        observations, rewards = play(env, seed, [RIGHT] * length + [turn(cue)])
        assert rewards == [0] * length + [1]
        assert observations[:, 0].tolist() == [0] * length + [1, 1]
        assert observations[1:-1, 1].tolist() == [0] * length  # the cue is seen once
        assert observations[0, 1] == observations[-1, 1] == cue
        cues.append(cue)
        assert play(env, seed, [RIGHT] * length + [turn(-cue)])[1] == [0] * (length + 1)
    assert set(cues) == {-1, 1}


def test_falling_behind_costs_and_never_pays():
    env = TMaze(4)
    cue = env.reset(seed=1)[0][1]
    for actions, falls in [
        ([LEFT, RIGHT, RIGHT, RIGHT], 4),
        ([RIGHT, RIGHT, UP, RIGHT], 2),
        ([RIGHT, LEFT, DOWN, RIGHT], 3),
    ]:
        _, rewards = play(env, 1, [*actions, turn(cue)])
        assert sum(rewards) == pytest.approx(-falls / 4)


@pytest.mark.parametrize("seed", range(20))
def test_ending_where_it_falls_behind_returns_the_same(seed):
    env, ending = TMaze(4), TMaze(4, end_when_behind=True)
    actions = np.random.default_rng(seed).choice(4, size=5, p=[0.7, 0.1, 0.1, 0.1])
    observations, rewards = play(env, seed, actions)
    steps = next((i for i, reward in enumerate(rewards, start=1) if reward < 0), 5)
    ended, ends = play(ending, seed, actions[:steps])
    assert ended.tolist() == observations[: steps + 1].tolist()
    assert sum(ends) == pytest.approx(sum(rewards))


def test_turning_is_for_the_junction():
    env = TMaze(3)
    observations, _ = play(env, 0, [UP, UP, DOWN, UP])
    assert not observations[1:].any()
    observations, _ = play(env, 0, [RIGHT, RIGHT, RIGHT, RIGHT])
    assert observations[-1].tolist() == [1, 0]


def test_gymnasium_knows_it():
    env = gymnasium.make("TMaze-v0", corridor_length=3, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.reset(seed=0)
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    assert picture.shape == (40, 48, 3)
    assert (TMaze(3).observation_space.shape, TMaze(3).render()) == ((2,), None)


@pytest.mark.parametrize("length", [0, -1, 2.0, True])
def test_bad_lengths(length):
    with pytest.raises(ValueError, match=f"integer from 1 on, not {length}"):
        TMaze(length)


def test_other_actions_are_gone():
    env = FirstActions(gymnasium.make("Taxi-v4"), 4)
    assert env.action_space == Discrete(4)
    env.reset(seed=0)
    expected = gymnasium.make("Taxi-v4")
    expected.reset(seed=0)
    for action in (0, 3, 2, 1):
        assert env.step(action)[0] == expected.step(action)[0]


@pytest.mark.parametrize("count", [0, 7])
def test_wrong_numbers_of_actions(count):
    with pytest.raises(ValueError, match=f"from 1 to 6, the task's actions, not {count}"):
        FirstActions(gymnasium.make("Taxi-v4"), count)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "make",
    [
        lambda: TMaze(3),
        lambda: TMaze(3, render_mode="rgb_array", end_when_behind=True),
        lambda: gymnasium.make("TMaze-v0", corridor_length=1),
        lambda: FirstActions(gymnasium.make("FrozenLake-v1"), count=3),
    ],
    ids=["t-maze", "t-maze-that-ends", "registered", "first-actions"],
)
def test_checker_of_stable_baselines3(make: Callable[[], gymnasium.Env]) -> None:
    env_checker.check_env(make())


@pytest.mark.parametrize("game", ["Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders"])
def test_games_of_minatar(game):
    minatar = pytest.importorskip("minatar")
    name = "_".join(re.findall("[A-Z][a-z]+", game)).lower()
    env: Any = gymnasium.make(f"MinAtar/{game}-v1", render_mode="rgb_array")
    plain = minatar.Environment(name)
    env.reset(seed=3)
    plain.seed(3)
    plain.reset()
    for step in range(200):
        action = step // 3 % env.action_space.n
        seen, reward, over, _, _ = env.step(action)
        assert (reward, over) == plain.act(plain.minimal_action_set()[action])
        assert np.array_equal(seen, plain.state())
        picture = env.render()
        assert picture.shape == (160, 160, 3)
        assert picture.dtype == np.uint8
        # What is in a cell gives it a color.
        assert np.array_equal(picture[8::16, 8::16].any(2), seen.any(2))
        if over:
            env.reset()
            plain.reset()
    assert env.spec.max_episode_steps == 10_000


def test_seeded_games_of_minatar_know_nothing_of_those_before():
    pytest.importorskip("minatar")
    env = gymnasium.make("MinAtar/Breakout-v1", sticky_action_prob=0.9)

    def played(before):
        env.reset(seed=1)
        for _ in range(20):
            env.step(before)
        env.reset(seed=0)
        return [env.step(0)[0] for _ in range(3)]

    assert np.array_equal(played(1), played(2))


def test_a_game_of_minatar_without_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "minatar.gym", None)
    with pytest.raises(
        ValueError, match=r"minatar is not .*: pip install 'torchrl-tit\[minatar\]'"
    ):
        gymnasium.make("MinAtar/Breakout-v1")
