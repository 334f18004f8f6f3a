"""Agents that act on NumPy arrays: as in an evaluation, one or many, with missing frames."""

from __future__ import annotations

import runpy
from copy import deepcopy
from functools import cache, reduce
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from recipes.bc import BC
from recipes.iql import IQL
from recipes.offline import with_spaces
from recipes.ppo import PPO
from recipes.sac import SAC
from tests.agents.runs import make_run
from tests.recipes.offline.test_without_env import log_machine
from tests.recipes.ppo import tasks as ppo_tasks
from tests.recipes.small import make_dt, tit, train
from torchrl_tit import load_agent
from torchrl_tit.agents import agent_names
from torchrl_tit.agents.acting import Actor
from torchrl_tit.envs.names import load_wrappers
from torchrl_tit.export import export_policy
from torchrl_tit.settings.literals import parse_assignments
from torchrl_tit.settings.networks import dt_tit, lstm, mlp

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "act_from_onnx.py"
STEPS = 12
OF_GYMNASIUM = [
    name for name in agent_names() if name not in ("breakout", "pong")
]  # Atari: our own


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Loads an agent by name; runs are made once."""

    @cache
    def run(name):
        folder = tmp_path_factory.mktemp(name)
        if name == "dt":
            backbone = dt_tit(4, embed_dim=8, num_blocks=1)
            dt = make_dt(folder, iterations=1, evaluation_episodes=1, backbone=backbone)
            return train(dt, folder / "run").folder
        small = {"hidden_dim": 8, "embed_dim": 8, "features_dim": 8}
        backbone = {"lstm": lstm(1, **small), "frames": mlp(3, hidden_dim=8)}[name]
        recipe = PPO(env="Pendulum-v1", backbone=backbone, evaluation_episodes=1)
        return make_run(folder / "run", recipe)

    return lambda name: load_agent(name if name in agent_names() else run(name))


def tasks(agent, count):
    settings = parse_assignments(agent.recipe["env_settings"])
    wraps, _ = load_wrappers(agent.recipe["wrappers"])
    made = [gymnasium.make(agent.recipe["env"], **settings) for _ in range(count)]
    return [reduce(lambda env, wrap: wrap(env), wraps, env) for env in made]


def seen(observation):
    """An observation as the agent's environment writes it, images with their channels first."""
    return np.moveaxis(observation, -1, 0) if observation.ndim == 3 else observation


@pytest.mark.parametrize("name", [*OF_GYMNASIUM, "dt", "lstm"])
def test_one_by_one_as_in_an_evaluation(made, name):
    agent = made(name)
    env = agent.make_env(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        first = env.reset(seed=4)
        steps = env.rollout(STEPS, agent.policy, auto_reset=False, tensordict=first)[0]
    [env] = tasks(agent, 1)
    observation, reward = env.reset(seed=4)[0], 0.0
    for expected, expected_reward in zip(steps["action"], steps["next", "reward"], strict=True):
        action = agent.act(seen(observation).tolist(), reward=reward)
        bounds = getattr(env.action_space, "low", None), getattr(env.action_space, "high", None)
        expected = expected.numpy() if bounds[0] is None else expected.numpy().clip(*bounds)
        np.testing.assert_allclose(action, expected, rtol=1e-4, atol=1e-5)
        observation, reward, *_ = env.step(action)
        assert reward == pytest.approx(expected_reward.item(), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("name", ["cartpole-no-velocity", "dt", "lstm"])
def test_many_at_a_time_each_as_if_alone(made, name):
    """Episodes begin at different times, in some copies only."""
    agent = made(name)
    draw = np.random.default_rng(0)
    [env] = tasks(agent, 1)
    frames = draw.normal(size=(STEPS, 3, *env.observation_space.shape))
    begins = draw.random((STEPS, 3)) < 0.3
    together = []
    for now, which in zip(frames, begins, strict=True):
        agent.reset(which)
        together.append(agent.act(now, reward=np.ones(3)))
    for copy in range(3):
        agent.reset()
        for step in range(STEPS):
            if begins[step, copy]:
                agent.reset()
            action = agent.act(frames[step, copy], reward=1.0)
            np.testing.assert_allclose(action, together[step][copy], rtol=1e-4, atol=1e-5)


def test_missing_values_are_held(made):
    agent = made("dt")
    draw = np.random.default_rng(0)
    frames = draw.normal(size=(5, 11))
    held, whole = frames.copy(), frames.copy()
    held[2], held[3, 4] = np.nan, np.nan
    whole[2], whole[3, 4] = frames[1], frames[1, 4]
    expected = [agent.act(frame) for frame in whole]
    agent.reset()
    for step, frame in enumerate(held):
        np.testing.assert_array_equal(agent.act(None if step == 2 else frame), expected[step])
    agent.reset()
    with pytest.raises(ValueError, match="the first observation of an episode is missing or has N"):
        agent.act(held[2])
    with pytest.raises(ValueError, match=r"has the shape \[4\], but must have \[11\]"):
        agent.act(np.zeros(4))
    with pytest.raises(ValueError, match=r"must have \[11\]: call reset\(\) before another number"):
        agent.act(np.zeros((2, 11)))
    with pytest.raises(ValueError, match="must be numbers, not <U1"):
        agent.act(np.array(["a"] * 11))
    with pytest.raises(ValueError, match="there are 2 rewards, but 1 copies"):
        agent.act(frames[0], reward=[1.0, 2.0])
    agent.reset()
    with pytest.raises(ValueError, match="observations of 0 copies"):
        agent.act(np.zeros((0, 11)))


@pytest.mark.parametrize("exported", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_that_the_caller_writes_again(made, tmp_path, exported, dtype):
    agent = made("frames")
    frames = np.random.default_rng(0).normal(size=(3, 3)).astype(dtype)
    expected = [agent.act(frame) for frame in (*frames[:2], [frames[1, 0], *frames[2, 1:]])]
    agent.reset()
    if exported:
        pytest.importorskip("onnxruntime")
        pytest.importorskip("onnxscript")
        file = tmp_path / "agent.onnx"
        export_policy(agent.policy, agent.make_env, file, step_by_step=True)
        agent = runpy.run_path(str(EXAMPLE))["Agent"](str(file))
    frames[2, 0] = np.nan
    buffer = np.empty(3, dtype)
    for frame, action in zip(frames, expected, strict=True):
        buffer[:] = frame
        np.testing.assert_allclose(agent.act(buffer), action, rtol=1e-4, atol=1e-5)


def test_actions_that_the_caller_writes_again(made):
    agent, frames = made("dt"), np.random.default_rng(0).normal(size=(5, 11))
    expected = [agent.act(frame).copy() for frame in frames]
    agent.reset()
    for frame, action in zip(frames, expected, strict=True):
        given = agent.act(frame)
        np.testing.assert_array_equal(given, action)
        given[...] = 7


@pytest.mark.parametrize("name", ["frames", "dt", "lstm"])
def test_a_copy_has_its_own_history_and_weights(made, name):
    agent = made(name)
    [size] = tasks(agent, 1)[0].observation_space.shape
    frames = np.random.default_rng(0).normal(size=(3, size))
    expected = [agent.act(frame) for frame in frames]
    agent.reset()
    agent.act(frames[0])
    other = deepcopy(agent)
    agent.act(-frames[1])
    for frame, action in zip(frames[1:], expected[1:], strict=True):
        np.testing.assert_array_equal(other.act(frame), action)
    first = agent.evaluate(1)
    torch.testing.assert_close(other.evaluate(1), first, rtol=0, atol=0)
    with torch.no_grad():
        for weight in other.policy.parameters():
            weight.mul_(-2)
    assert other.evaluate(1) != first
    torch.testing.assert_close(agent.evaluate(1), first, rtol=0, atol=0)


def test_what_is_refused_leaves_nothing_behind(made, tmp_path):
    agent, frames = made("dt"), np.random.default_rng(0).normal(size=(3, 11))
    expected = [agent.act(frame) for frame in frames]
    agent.reset()
    for frame, action in zip(frames, expected, strict=True):
        for reward in (np.nan, -np.inf, None):
            with pytest.raises(ValueError, match="not a finite number"):
                agent.act(frame, reward=reward)
        np.testing.assert_array_equal(agent.act(frame), action)
    lake = PPO(env="FrozenLake-v1", backbone=mlp(3, hidden_dim=8), evaluation_episodes=1)
    agent = load_agent(make_run(tmp_path / "run", lake))
    expected = [agent.act(state) for state in (0, 4, 8, 9)]  # numbers, as Gymnasium has them
    agent.reset()
    for state, action in zip((0, 4, 8, 9), expected, strict=True):
        with pytest.raises(ValueError, match=r"is \[\[16\]\], which its space lacks"):
            agent.act([16])
        assert agent.act([state]) == action


def test_only_reset_begins_an_episode(tmp_path):
    """And no time limit of the task that the agent was trained on."""
    limit = "torchrl.envs.transforms:StepCounter(max_steps=3)"
    backbone = mlp(2, hidden_dim=8)
    recipe = PPO(env="Pendulum-v1", wrappers=(limit,), backbone=backbone, evaluation_episodes=1)
    agent = load_agent(make_run(tmp_path / "run", recipe))
    actor = Actor(agent.policy, agent.make_env)
    frames = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    for before, frame in zip([frames[0], *frames], frames):  # noqa: B905 (one is longer)
        actor.act(frame)
        assert actor._steps is not None
        np.testing.assert_array_equal(actor._steps["history"][0], [before, frame])


def test_masks_of_several_choices(tmp_path):
    """As Gymnasium has them, or in one row."""
    recipe = PPO(
        env="MultiDiscreteActions-v0",
        backbone=mlp(2, hidden_dim=8),
        mask_actions=True,
        evaluation_episodes=1,
    )
    agent = load_agent(make_run(tmp_path / "run", recipe))
    space: Any = ppo_tasks.ACTIONS["MultiDiscrete"]
    observation = {"image": np.zeros((3, 12, 12), np.uint8), "state/0": np.ones(3), "state/1": [2]}
    masks = tuple(np.eye(n, dtype=bool)[-1] for n in space.nvec)
    action = agent.act(observation, action_mask=masks)
    assert action.tolist() == (space.nvec - 1 + space.start).tolist(), "the last of each"
    agent.reset()
    assert (agent.act(observation, action_mask=np.concatenate(masks)) == action).all()
    with pytest.raises(ValueError, match="action_mask must be 0 or 1 for each action"):
        agent.act(observation, action_mask=np.concatenate(masks) * np.nan)
    with pytest.raises(ValueError, match="action_mask has the shape"):
        agent.act(observation, action_mask=masks[0])
    with pytest.raises(ValueError, match="action_mask allows no action: give every copy"):
        agent.act(observation, action_mask=tuple(np.zeros(n, bool) for n in space.nvec))
    misspelled = observation | {"picture": 1}
    del misspelled["image"]
    for _ in range(2):  # after a first observation, and as the first one
        with pytest.raises(ValueError, match="has state/0, state/1, picture, but not image: give"):
            agent.act(misspelled, action_mask=masks)
        with pytest.raises(ValueError, match="must be a mapping with image, state/0, state/1, not"):
            agent.act(1.0, action_mask=masks)
        agent = load_agent(tmp_path / "run")
    agent.act(observation, action_mask=masks)
    held = agent.act(observation | {"image": None}, action_mask=masks)
    assert held.tolist() == action.tolist()


def test_images_are_not_cut_to_bytes(tmp_path):
    """An image scaled to 0..1 would be black."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    images = np.random.default_rng(0).integers(0, 256, (200, 12, 12), np.uint8)
    data = log_machine(tmp_path / "log.hdf5", observations=images)
    recipe = with_spaces(BC(dataset=str(data), backbone=tit(2), total_updates=1))
    agent, file = load_agent(train(recipe, tmp_path / "run").folder), tmp_path / "agent.onnx"
    export_policy(agent.policy, agent.make_env, file, step_by_step=True)
    exported = runpy.run_path(str(EXAMPLE))["Agent"](str(file))
    found, expected = exported.act(images[0]), agent.act(images[0].astype(float))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
    with pytest.raises(ValueError, match="2 copies act, not 1"):
        exported.act(images[:2])
    for act, value in product((agent.act, exported.act), (0.5, 256, -1)):
        with pytest.raises(ValueError, match="0 to 255"):
            act(np.full((12, 12), value))


def test_an_agent_without_an_environment(tmp_path):
    recipe = IQL(
        dataset=str(log_machine(tmp_path / "log.hdf5", actions=np.full((200, 2), [0.0, 70.0]))),
        backbone=tit(3),
        total_updates=2,
        normalize_observations=True,
    )
    run = train(with_spaces(recipe), tmp_path / "run")
    (tmp_path / "log.hdf5").rename(tmp_path / "elsewhere.hdf5")
    agent = load_agent(run.folder)
    actions = np.stack([agent.act(frame) for frame in np.random.default_rng(0).normal(size=(5, 5))])
    assert ((actions >= [-1, 69]) & (actions <= [1, 71])).all()
    assert len({*actions[:, 1].tolist()}) == 5
    assert torch.is_grad_enabled()


@pytest.mark.parametrize("name", ["frames", "dt", "lstm"])
def test_a_file_acts_as_its_agent(made, tmp_path, name):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    agent, file = made(name), tmp_path / "agent.onnx"
    export_policy(agent.policy, agent.make_env, file, step_by_step=True)
    exported = runpy.run_path(str(EXAMPLE))["Agent"](str(file))
    draw = np.random.default_rng(0)
    [env] = tasks(agent, 1)
    for size in ((), (3,)):
        agent.reset()
        exported.reset()
        for step in range(STEPS):
            frames = draw.normal(size=(*size, *env.observation_space.shape))
            if step:
                frames[..., 0][draw.random(size) < 0.5] = np.nan
            if size and step == 5:
                agent.reset([True, False, False])
                exported.reset([True, False, False])
                frames[0] = 0
            expected = agent.act(frames, reward=1.0)
            found = exported.act(frames, reward=1.0)
            assert found.dtype == expected.dtype
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
        expected, found = agent.act(None, reward=1.0), exported.act(None, reward=1.0)
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
        for reset in (agent.reset, exported.reset):
            with pytest.raises(ValueError, match="which must be"):
                reset([True, False])
    [size] = env.observation_space.shape
    for frames in (np.zeros(2 * size), np.zeros((3, 2 * size)), np.zeros((2, 3, size))):
        with pytest.raises(ValueError, match="expected observations"):
            exported.act(frames)
    for act, reward in product((agent.act, exported.act), (np.nan, np.inf)):
        with pytest.raises(ValueError, match="not a finite number"):
            act(np.zeros((3, size)), reward=reward)
    for act, value in product((agent.act, exported.act), (np.inf, -np.inf, 1e300)):
        with np.errstate(over="ignore"), pytest.raises(ValueError, match="is infinite in"):
            act(np.full((3, size), value))
    for reset, which in product((agent.reset, exported.reset), ([0, 1], 1)):
        with pytest.raises(ValueError, match="which must be "):  # bool, not the numbers of copies
            reset(which)
    exported.reset([False, True, False])
    frames = np.zeros((3, size))
    frames[1, 0] = np.nan
    with pytest.raises(ValueError, match="the first observation of an episode is missing or has N"):
        exported.act(frames)


def test_transforms_that_change_actions(tmp_path):
    """The policy's actions are between -1 and 1, the task's between -2 and 2."""
    recipe = SAC(
        env="Pendulum-v1",
        backbone=mlp(hidden_dim=8),
        wrappers=("torchrl.envs:ActionScaling",),
        evaluation_episodes=1,
    )
    agent = load_agent(make_run(tmp_path / "run", recipe))
    frames = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        steps = TensorDict({"observation": frames, "history": frames[:, None]}, [6])
        chosen = agent.policy(steps)["action"].numpy()
    assert 0.01 < np.abs(chosen).max() <= 1
    np.testing.assert_allclose(agent.act(frames), 2 * chosen, rtol=1e-5)
    with pytest.raises(ValueError, match="changes actions by ActionScaling, which a file cannot"):
        export_policy(agent.policy, agent.make_env, tmp_path / "agent.pt2")
