"""Atari games are what Stable-Baselines3's AtariWrapper makes of them, and keep our contract."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import assert_close

from torchrl_tit.envs import AtariEnv, AtariGames, make_env
from torchrl_tit.evaluation import evaluate, finished_returns

ale_py = pytest.importorskip("ale_py")

RIGHT, LEFT = 2, 3


class Wrapped:
    """One game in Stable-Baselines3's wrapper, which begins with as many no-ops as told."""

    def __init__(self, task, seed):
        wrappers = pytest.importorskip("stable_baselines3.common.atari_wrappers")
        pytest.importorskip("cv2")
        gymnasium.register_envs(ale_py)
        self.env = wrappers.AtariWrapper(gymnasium.make(f"{task}NoFrameskip-v4"))
        layer = self.env
        while not isinstance(layer, wrappers.NoopResetEnv):
            layer = layer.env
        self.noop_reset = layer
        game = self.env.unwrapped
        game.ale.setInt("random_seed", seed)
        game.load_game()
        self.frames = np.zeros((4, 84, 84), int)

    def begin(self, noops):
        self.noop_reset.override_num_noops = noops
        self.frames[:] = 0  # as Stable-Baselines3 stacks frames
        self.frames[-1] = self.env.reset()[0][..., 0]

    def step(self, action):
        picture, reward, terminated, truncated, _ = self.env.step(action)
        self.frames = np.concatenate([self.frames[1:], picture[None, ..., 0]])
        return reward, terminated, truncated


def assert_same_frames(history, frames):
    # Grey and area interpolation are rounded in the other order.
    assert (history.int() - torch.from_numpy(frames)).abs().max() <= 1


@pytest.mark.parametrize(
    ("task", "num_envs", "steps"),
    [
        *(("Breakout", 2, 350), ("MsPacman", 1, 700), ("Pong", 1, 1100)),
        pytest.param("SpaceInvaders", 2, 700, marks=pytest.mark.slow),
    ],
)
def test_equals_stable_baselines3(task, num_envs, steps):
    env = make_env(f"ALE/{task}-v5", num_envs, num_frames=4, padding="constant")
    assert isinstance(env.base_env, AtariEnv)
    assert isinstance(env.base_env._env, AtariGames)
    wrapped = [Wrapped(task, seed) for seed in range(num_envs)]
    root, begins = env.reset(seed=0), torch.ones(num_envs, 1, dtype=torch.bool)
    torch.manual_seed(0)
    for _ in range(steps):
        for i in begins.flatten().nonzero().flatten():
            wrapped[i].begin(int(env.base_env._env._noops[i]))
        for i in range(num_envs):
            assert_same_frames(root["history"][i], wrapped[i].frames)
        step, root = env.step_and_maybe_reset(env.rand_action(root))
        outcome = step["next"]
        for i, action in enumerate(step["action"]):
            reward, terminated, truncated = wrapped[i].step(int(action))
            assert outcome["reward"][i].sign() == reward
            assert outcome["terminated"][i] == terminated
            assert outcome["truncated"][i] == truncated
            # The wrapper has no picture of a game's very end.
            if terminated and not outcome["game_over"][i]:
                assert_same_frames(outcome["history"][i], wrapped[i].frames)
        begins = outcome["done"]
    env.close()


@pytest.fixture(scope="module")
def breakout():
    """Two games of Breakout. With the paddle kept left a life is lost in 23 steps, always."""
    env = make_env("ALE/Breakout-v5", 2, num_frames=2)
    yield env
    env.close()


def play(env, steps, action=None):
    """The same steps each time: one action, or any by chance."""
    generator = torch.Generator().manual_seed(0)
    root, played = env.reset(seed=3), []
    for _ in range(steps):
        chance = torch.randint(env.action_spec.space.n, env.batch_size, generator=generator)
        root["action"] = chance if action is None else torch.full_like(chance, action)
        step, root = env.step_and_maybe_reset(root)
        played.append((step.clone(), root.clone()))
    return played


def stacked(played):
    """What was played as a batch [N, steps]: the steps, and what came next."""
    return tuple(torch.stack(parts, 1) for parts in zip(*played, strict=True))


def test_five_lives_are_a_game(breakout):
    batch, roots = stacked(play(breakout, 250))
    steps = batch["next"]
    for i in range(2):
        first_game = int(steps["game_over"][i].nonzero()[0, 0]) + 1
        assert steps["done"][i, :first_game].sum() == 5
        rewards = steps["reward"][i, :first_game].sum()
        assert steps["game_return"][i, first_game - 1] == rewards
    assert steps["game_return"].max() > 0
    # A game's return continues after a lost life and starts anew with a game; an episode's always.
    lost = steps["done"] & ~steps["game_over"]
    assert torch.equal(roots["game_return"][lost], steps["game_return"][lost])
    assert not roots["game_return"][steps["game_over"]].any()
    assert not roots["episode_reward"][steps["done"]].any()
    assert steps["terminated"][steps["done"]].all()
    assert not roots["game_over"].any()
    assert torch.equal(finished_returns(batch), steps["game_return"][steps["game_over"]])


def test_a_seeded_reset_repeats_exactly(breakout):
    first = play(breakout, 60)
    for (step, root), (again, root_again) in zip(first, play(breakout, 60), strict=True):
        assert_close(step, again, 0, 0)
        assert_close(root, root_again, 0, 0)
    assert not torch.equal(first[-1][1]["observation"][0], first[-1][1]["observation"][1])


def test_only_a_full_reset_begins_new_games(breakout):
    play(breakout, 22, LEFT)
    lives = breakout.base_env._env._lives
    root = breakout.rand_action(play(breakout, 22, LEFT)[-1][1])
    assert breakout.step(root)["next", "terminated"].all()
    assert lives.tolist() == [4, 4]
    breakout.reset(root.set("_reset", torch.tensor([[True], [False]])))
    assert lives.tolist() == [4, 4]
    breakout.reset()
    assert lives.tolist() == [5, 5]


def test_games_are_cut_off():
    env = make_env("ALE/Pong-v5", 1, max_num_frames_per_episode=100, noop_max=0)
    steps = stacked(play(env, 50))[0]["next"]
    cut = steps["truncated"].flatten()
    # Of 100 frames, 4 of fire and 4 of action 2 come first.
    assert cut.nonzero().flatten().tolist() == [22, 45]
    assert torch.equal(cut, steps["game_over"].flatten())
    assert not steps["terminated"].any()
    env.close()


def test_a_flickering_game_is_the_same_game():
    plain, flickering = AtariGames("pong", 2), AtariGames("pong", 2, blank_probability=0.5)
    blank = []
    for repeat in range(2):
        shown, seen = plain.reset(seed=3)[0], flickering.reset(seed=3)[0]
        for _ in range(100):
            dark = ~seen.any((1, 2))
            assert np.array_equal(shown[~dark], seen[~dark])
            blank.append(dark)
            actions = np.array([RIGHT, LEFT])
            shown, seen = plain.step(actions)[0], flickering.step(actions)[0]
        if repeat:  # a seeded reset also repeats what is blank
            assert np.array_equal(blank[:100], blank[100:])
    assert 70 < np.sum(blank[:100]) < 130  # of 200, with a standard deviation of 7
    assert (np.array(blank[:100]).sum(1) == 1).any()  # each game by itself
    plain.close()
    flickering.close()


def test_evaluation_counts_whole_games():
    def act(sums):
        return sums // 7 % 6  # anything that follows from the picture

    def policy(root):
        return root.set("action", act(root["observation"].flatten(1).sum(1)))

    returns = evaluate(lambda n: make_env("ALE/SpaceInvaders-v5", n), policy, episodes=2, seed=3)
    games = AtariGames("space_invaders", 1)
    for i in range(2):
        image, _ = games.reset(seed=3 + i)
        lives, over, points = 1, False, 0.0
        while not over:
            action = act(image.sum(keepdims=True, dtype=int)[:, 0, 0])
            image, rewards, terminated, _, info = games.step(action)
            points, over = points + rewards[0], info["game_over"][0]
            if terminated and not over:
                lives += 1
                image, _ = games.reset(options={"reset_mask": terminated})
        assert lives == 3
        assert returns[i] == points > 0
    games.close()


def test_pictures_of_the_games():
    games = AtariGames("breakout", 2, render_mode="rgb_array")
    games.reset(seed=0)
    for action in [RIGHT] * 20 + [LEFT] * 60:
        image, *_ = games.step(np.full(2, action))
        screen, _ = games.render()
        assert screen.shape == (210, 160, 3)
        # The small picture is of the same moment as the large one.
        gray = torch.from_numpy(screen @ np.array([0.299, 0.587, 0.114]))
        small = torch.nn.functional.interpolate(gray[None, None], (84, 84), mode="area")[0, 0]
        assert np.corrcoef(small.flatten(), image[0].flatten())[0, 1] > 0.95
    games.close()
    with pytest.raises(ValueError, match='only with render_mode="rgb_array"'):
        AtariGames("pong").render()


def test_bad_input():
    with pytest.raises(ValueError, match="'ALE/Pog-v5'; did you mean ALE/Pong-v5"):
        make_env("ALE/Pog-v5")
    with pytest.raises(ValueError, match="runs in threads, side by side"):
        make_env("ALE/Pong-v5", vectorization_mode="async")


@pytest.mark.parametrize("name", ["PongNoFrameskip-v4", "Pong-v4"])
def test_names_without_the_preprocessing_are_refused(name):
    gymnasium.register_envs(ale_py)
    with pytest.raises(ValueError, match=f"{name}.*without the preprocessing.*'ALE/Pong-v5'"):
        make_env(name)
