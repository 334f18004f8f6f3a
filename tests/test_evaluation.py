"""Evaluation plays whole episodes, deterministically, and leaves no trace in training."""

import math
import random
from contextlib import nullcontext
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from tensordict.nn import TensorDictModule as Module
from torch import nn
from torchrl.envs import GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.modules import IndependentNormal

from tests.envs.reference import wrapped
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate


def lean(tensordict):
    """Pushes the cart to the side that the pole leans to."""
    return tensordict.set("action", (tensordict["observation"][..., 2] > 0).long())


def played_by_hand(name, act, seed, episodes):
    """The same episodes, one after the other, in plain Gymnasium."""
    returns = []
    for i in range(episodes):
        task = gymnasium.make(name)
        observation, _ = task.reset(seed=seed + i)
        total, done = 0.0, False
        while not done:
            observation, reward, terminated, truncated, _ = task.step(act(observation))
            total, done = total + float(reward), terminated or truncated
        returns.append(total)
    return torch.tensor(returns, dtype=torch.float64)


def by_leaning(episodes):
    returns = played_by_hand("CartPole-v1", lambda x: int(x[2] > 0), seed=7, episodes=episodes)
    assert returns.unique().numel() > 3
    return returns


@pytest.mark.parametrize("num_envs", [1, 4, 9, 20])
def test_equals_episodes_played_by_hand_with_any_number_of_environments(num_envs):
    env = make_env("CartPole-v1", num_envs, seed=1)
    env.rollout(5)
    assert torch.equal(evaluate(env, lean, episodes=9, seed=7), by_leaning(9))
    assert not env.is_closed


def test_actions_can_be_drawn():
    head = ProbabilisticTensorDictModule(
        ["logits"], ["action"], distribution_class=torch.distributions.Categorical
    )
    logits = Module(
        lambda x: torch.tensor([0.0, 2.0]).expand(*x.shape[:-1], 2), ["observation"], ["logits"]
    )
    policy = ProbabilisticTensorDictSequential(logits, head)

    def returns(**settings):
        return evaluate(lambda n: make_env("CartPole-v1", n), policy, 30, **settings)

    drawn = returns(deterministic=False)
    assert torch.equal(drawn, returns(deterministic=False))  # from the seed
    assert not torch.equal(drawn, returns(deterministic=False, seed=1))
    # Now and then the other side holds the pole up for longer than always the same one.
    assert drawn.mean() > returns().mean() + 1


@pytest.mark.parametrize("num_envs", [1, 4, 9])
def test_shrinking_asks_only_about_what_still_counts(num_envs):
    expected = by_leaning(9)
    asked = []

    def policy(tensordict):
        asked.append(len(tensordict))
        return lean(tensordict)

    env = make_env("CartPole-v1", num_envs)
    assert torch.equal(evaluate(env, policy, episodes=9, seed=7, shrink=True), expected)
    playing = [sum(ret > step for ret in expected) for step in range(int(expected.max()))]
    assert asked == playing or num_envs < 9


def test_torchrls_own_environments():
    make = partial(GymEnv, "CartPole-v1", categorical_action_encoding=True)
    pairs = SerialEnv(2, partial(make_env, "CartPole-v1", 2))
    copies = TransformedEnv(SerialEnv(3, make), StepCounter())
    for env in (make(), copies, pairs, wrapped("CartPole-v1", 3, 0, 2, "same")):
        assert torch.equal(evaluate(env, lean, episodes=4, seed=7), by_leaning(4))


def gaussian_policy(dropout=0.0):
    """A linear Gaussian policy for Pendulum-v1; [N, 3] to an unclipped action [N, 1]."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Dropout(dropout), nn.Linear(3, 1), nn.Tanh())
    mean = Module(network, ["observation"], ["loc"])
    scale = Module(lambda loc: torch.full_like(loc, 0.7), ["loc"], ["scale"])
    sample = ProbabilisticTensorDictModule(
        ["loc", "scale"], ["action"], distribution_class=IndependentNormal, return_log_prob=True
    )
    return ProbabilisticTensorDictSequential(mean, scale, sample), network


def test_the_policy_acts_its_mean_in_evaluation_mode_and_without_gradients():
    policy, network = gaussian_policy(dropout=0.5)
    gradients = []
    network.register_forward_hook(lambda *_: gradients.append(torch.is_grad_enabled()))

    def mean(observation):
        with torch.no_grad():
            return network[1:](torch.as_tensor(observation, dtype=torch.float32)).numpy()

    expected = played_by_hand("Pendulum-v1", mean, seed=3, episodes=3)
    returns = evaluate(lambda n: make_env("Pendulum-v1", n), policy, episodes=3, seed=3)
    torch.testing.assert_close(returns, expected, rtol=1e-4, atol=1e-3)
    assert gradients == [False] * 200


def draw():
    return torch.rand(1).item(), np.random.rand(), random.random()


@pytest.mark.parametrize("fails", [False, True])
def test_modes_and_generators_are_left_as_they_were_also_by_an_error(fails):
    policy, network = gaussian_policy(dropout=0.5)
    policy.train()
    network[1].eval()
    network[1].register_forward_hook(lambda *_: 1 / 0 if fails else None)
    modes = [module.training for module in policy.modules()]
    made = []

    def factory(count):
        draw()
        made.append(make_env("Pendulum-v1", count, max_episode_steps=5))
        return made[-1]

    def drawing(tensordict):
        draw()
        return policy(tensordict)

    def seeded():
        for seed in (torch.manual_seed, np.random.seed, random.seed):
            seed(5)

    seeded()
    expected = draw()
    seeded()
    for acting in (policy, drawing):
        with pytest.raises(ZeroDivisionError) if fails else nullcontext():
            evaluate(factory, acting, episodes=2)
    assert draw() == expected
    assert [module.training for module in policy.modules()] == modes
    assert all(env.is_closed and env.batch_size == (2,) for env in made)


def test_no_episodes():
    with pytest.raises(ValueError, match="episodes must be at least 1, not 0"):
        evaluate(make_env("CartPole-v1"), lean, episodes=0)


class Paying(gymnasium.Env):
    """Episodes of one step or, with an odd seed, three; later ones pay another reward."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, later: float, now: float = 1.0) -> None:
        self.pays, self.later = now, later

    def reset(self, *, seed=None, options=None):
        if seed is None:
            self.pays = self.later
        self.left = 3 if seed is None or seed % 2 else 1
        return self.observation_space.low, {}

    def step(self, action):
        self.left -= 1
        return self.observation_space.low, self.pays, self.left == 0, False, {}


gymnasium.register("Paying-v0", f"{__name__}:Paying")


@pytest.mark.parametrize("later", [math.inf, math.nan])
def test_rewards_of_later_episodes_do_not_count(later):
    returns = evaluate(lambda n: make_env("Paying-v0", n, later=later), go, episodes=4)
    assert returns.tolist() == [1, 3, 1, 3]


@pytest.mark.parametrize("now", [math.inf, -math.inf, math.nan])
def test_a_reward_that_is_not_finite_is_named(now):
    with pytest.raises(FloatingPointError, match=rf"^the reward of copy 0 is {now}$"):
        evaluate(lambda n: make_env("Paying-v0", n, later=1.0, now=now), go, episodes=4)


def go(tensordict):
    return tensordict.set("action", torch.zeros(tensordict.shape, dtype=torch.int64))
