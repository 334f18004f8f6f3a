"""`explain`: films and pictures of what an agent looks at."""

import sys
from dataclasses import replace
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from recipes.bc import BC
from recipes.cli import main
from recipes.core.runner import load_trained
from recipes.dqn import DQN
from recipes.offline import with_spaces
from recipes.ppo import PPO
from recipes.tools.results import explanation, paper_figures
from tests.recipes.commands import fails
from tests.recipes.offline.test_without_env import log_machine
from tests.recipes.small import make_cartpole_dt, make_discrete_cql, train
from tests.recipes.untrained import untrained
from torchrl_tit.datasets import load_episodes
from torchrl_tit.evaluation import evaluate
from torchrl_tit.settings.networks import enhanced_tit, mlp, nature_cnn

TIT: dict[str, Any] = {"patch_size": "auto", "embed_dim": 8, "num_blocks": 1, "features_dim": 8}
PAGE = (432, 768, 3)


def make_ppo(env, backbone, **fields):
    return PPO(name="explained", env=env, backbone=backbone, total_steps=64, **fields)


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    recipe = make_ppo("CartPole-v1", enhanced_tit(3, **TIT))
    return untrained(tmp_path_factory.mktemp("run") / "cartpole", recipe)


def explain(*words):
    main(["explain", *map(str, words)])


def test_a_film_of_an_array_task(cartpole, tmp_path, capsys):
    pytest.importorskip("pygame")
    pytest.importorskip("captum")
    film = tmp_path / "film.gif"
    explain(cartpole.folder, "--out", film, "--seed", 5, "--max-steps", 3)
    assert capsys.readouterr().out.splitlines() == [
        "3 steps of the episode of seed 5",
        f"written to {film}",
    ]
    pictures = imageio.imread(film)
    assert pictures.shape == (3, *PAGE)
    assert all((pictures[i] != pictures[i + 1]).any() for i in range(2))
    assert [path.name for path in tmp_path.iterdir()] == [film.name]


def test_a_whole_episode_and_a_picture_of_a_step_of_it(cartpole, tmp_path, capsys, monkeypatch):
    pytest.importorskip("pygame")
    pytest.importorskip("captum")
    # As fast as pages of one pixel.
    drawn = []

    class Small:
        def __init__(self, step, title, dpi):
            drawn.append(title)

        def draw(self, step, pictures, values, number):
            drawn.append((number, len(pictures), len(values), step.attention.shape))
            return np.full((2, 2, 3), number, np.uint8)

    monkeypatch.setattr("recipes.tools.results.explanation.Page", Small)
    _, algorithm, _ = load_trained(cartpole)
    (length,) = evaluate(algorithm.make_env, algorithm.policy, 1, seed=7).int().tolist()
    explain(cartpole.folder, "--out", tmp_path / "film.gif", "--seed", 7)
    assert drawn[0] == "explained"
    numbers = [(n, min(n + 1, 3), n + 1, (1, 1, 3)) for n in range(length)]
    assert drawn[1:] == numbers

    drawn.clear()
    explain(cartpole.folder, "--out", tmp_path / "step.png", "--seed", 7, "--step", length - 1)
    assert drawn[1:] == numbers[-1:], "a picture is that of the film"
    capsys.readouterr()
    words = [cartpole.folder, "--out", tmp_path / "no.png", "--seed", 7, "--step", length]
    line = fails(capsys, "explain", *words)
    assert f"the episode of seed 7 has {length} steps, so there is no step {length}" in line
    assert {path.name for path in tmp_path.iterdir()} == {"film.gif", "step.png"}


def test_an_image_task(tmp_path):
    pytest.importorskip("ale_py")
    backbone = enhanced_tit(2, **{**TIT, "patch_size": 42})
    run = untrained(tmp_path / "run", make_ppo("ALE/Pong-v5", backbone, num_envs=2))
    pictures: dict[object, np.ndarray] = {}
    for words in (
        ["--step", 1],
        ["--step", 1, "--target", "value"],
        ["--step", 1, "--map", "attention"],
    ):
        out = tmp_path / f"{len(pictures)}.png"
        explain(run.folder, "--out", out, *words)
        pictures[words[-1]] = imageio.imread(out)
        assert pictures[words[-1]].shape == PAGE
    assert (pictures[1] != pictures["value"]).any()
    assert (pictures[1] != pictures["attention"]).any()


def make_pendulum(folder):
    return make_ppo("Pendulum-v1", mlp())


@pytest.mark.parametrize("make", [make_discrete_cql, make_cartpole_dt, make_pendulum])
def test_other_policies(make, tmp_path):
    pytest.importorskip("pygame")
    pytest.importorskip("captum")
    run = untrained(tmp_path / "run", make(tmp_path))
    explain(run.folder, "--out", tmp_path / "a.png", "--step", 1)
    assert imageio.imread(tmp_path / "a.png").shape == PAGE


def test_maps_that_a_network_does_not_have(cartpole, tmp_path, capsys, monkeypatch):
    pytest.importorskip("pygame")
    out = tmp_path / "a.png"

    def refused(run, *words):
        line = fails(capsys, "explain", run.folder, "--out", out, *words)
        assert not out.exists()
        return line

    assert "nothing for Grad-CAM to map" in refused(cartpole, "--map", "grad-cam")
    assert "no layer 'blocks.9' in this network" in refused(cartpole, "--layer", "blocks.9")
    assert "a layer is for grad-cam, not for attention" in refused(
        cartpole, "--layer", "head.0", "--map", "attention"
    )
    recipe = replace(cartpole.recipe, backbone=mlp())
    run = untrained(tmp_path / "run", recipe)
    assert "no attention over the parts of an observation" in refused(run, "--map", "attention")
    monkeypatch.setitem(sys.modules, "captum.attr", None)
    assert "need captum: pip install 'torchrl-tit[explain]'" in refused(cartpole)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.fixture(scope="module")
def pong(tmp_path_factory):
    """Untrained agents of several networks, which read the last two or three frames of Pong."""
    pytest.importorskip("ale_py")
    folder = tmp_path_factory.mktemp("pong")
    networks = {
        "tit": enhanced_tit(2, **{**TIT, "patch_size": 42, "num_blocks": 2}),
        "cnn": nature_cnn(3),
    }
    return {
        name: untrained(folder / name, make_ppo("ALE/Pong-v5", network, num_envs=2)).folder
        for name, network in networks.items()
    }


def test_maps_of_several_agents_on_the_same_frames(pong, tmp_path, monkeypatch):
    drawn = []

    def save(figure, out):
        drawn.append([axes.images[0].get_array() for axes in figure.axes])
        drawn.append([axes.get_title() for axes in figure.axes if axes.get_title()])

    monkeypatch.setattr(paper_figures, "_save", save)
    explain(pong["tit"], pong["cnn"], "--step", 3, 1, "--out", tmp_path / "a.png")
    explain(pong["tit"], "--step", 1, 3, "--out", tmp_path / "b.png")
    both, titles, alone, _ = drawn
    assert titles == ["observation", "tit", "cnn"]
    assert len(both) == 2 * 3
    for first, same in zip((0, 1, 3, 4), alone, strict=True):
        assert (both[first] == same).all(), "the first agent plays as it does alone"
    assert (both[0] != both[3]).any(), "other steps"
    assert any((both[i] != both[i - i % 3]).any() for i in (2, 5)), "the maps lie over the frames"


def test_weights_of_all_blocks(pong, cartpole, tmp_path, monkeypatch):
    explain(pong["tit"], "--map", "weights", "--step", 2, "--out", tmp_path / "a.png")
    assert imageio.imread(tmp_path / "a.png").ndim == 3
    panels = {}

    def save(figure, out):
        for axes in figure.axes:
            if axes.get_title():
                panels[axes.get_title()] = np.asarray(axes.images[0].get_array())

    monkeypatch.setattr(paper_figures, "_save", save)
    explain(pong["tit"], "--map", "weights", "--step", 2, "--out", tmp_path / "b.png")
    inner = {f"inner block {block}, {at}" for block in (1, 2) for at in ("t-1", "t")}
    outer = {f"outer block {block}, head 1" for block in (1, 2)}
    assert set(panels) == inner | outer | {"observation, t-1", "observation, t"}
    for title in outer:
        assert panels[title].shape == (2, 2)
        assert np.allclose(panels[title].sum(1), 1)
        assert panels[title][0, 1] == 0, "no step reads a later one"
    for title in inner:
        assert panels[title].shape == (2, 2), "84 pixels in patches of 42"
        assert (panels[title] > 0).all()
        assert panels[title].sum() < 1
    panels.clear()
    explain(cartpole.folder, "--map", "weights", "--out", tmp_path / "b.png")
    assert panels["outer block 1, head 1"].shape == (3, 3)
    assert len(panels) == 1, "an array is one patch"


@pytest.fixture
def explained(monkeypatch):
    """What is explained, in order."""
    seen, explain_one = [], explanation.Explainer.explain

    def watch(self, tensordict):
        seen.append(tensordict.clone())
        return explain_one(self, tensordict)

    monkeypatch.setattr(explanation.Explainer, "explain", watch)
    return seen


def test_a_recorded_episode(tmp_path, capsys, explained):
    """Each frame of it is explained as where the policy plays, with the actions of the data."""
    pytest.importorskip("captum")
    data, out = log_machine(tmp_path / "log.hdf5"), tmp_path / "step.png"
    recipe = with_spaces(BC(dataset=str(data), backbone=enhanced_tit(3, **TIT), total_updates=1))
    run = train(recipe, tmp_path / "run")
    explain(run.folder, "--dataset", data, "--episode", 3, "--step", 7, "--out", out)
    line = capsys.readouterr().out.splitlines()[0]
    assert line == f"1 step of episode 3 of {data}"
    assert imageio.imread(out).shape == PAGE
    recorded = load_episodes(data).rows[3 * 21 : 4 * 21]
    assert explained[0]["history"][0].tolist() == recorded["observation"][5:8].tolist()
    for words, message in {
        ("--episode", "10"): "has 10 episodes, so there is no episode 10",
        ("--step", "20"): "the episode of the data has 20 steps, so there is no step 20",
        ("--seed", "1"): "leave it out with --dataset",
    }.items():
        more = ["--dataset", data, "--out", tmp_path / "no.png", *words]
        assert message in fails(capsys, "explain", run.folder, *more)


def test_a_time_limit_of_the_task_does_not_cut_a_recorded_episode(tmp_path, explained):
    pytest.importorskip("captum")
    limit = "torchrl.envs.transforms:StepCounter(max_steps=3)"
    recipe = make_ppo("Pendulum-v1", enhanced_tit(3, **TIT), wrappers=(limit,))
    observations, actions = np.random.default_rng(0).normal(size=(200, 3)), np.zeros((200, 1))
    data = log_machine(tmp_path / "log.hdf5", observations=observations, actions=actions)
    run = untrained(tmp_path / "run", recipe)
    explain(run.folder, "--dataset", data, "--step", 7, "--out", tmp_path / "step.png")
    [history] = [one["history"][0].numpy() for one in explained]
    np.testing.assert_array_equal(history, observations[5:8].astype(np.float32))


def test_recorded_episodes_are_those_of_the_agents_task(tmp_path, capsys, explained):
    """As it writes them: categories are counted from 0, and floats are none."""
    pytest.importorskip("captum")
    run = untrained(tmp_path / "run", make_ppo("FrozenLake-v1", enhanced_tit(2, **TIT)))
    states, actions = np.arange(200)[:, None] % 16, np.arange(200) % 4
    data = log_machine(tmp_path / "a.hdf5", observations=states, actions=actions)
    explain(run.folder, "--dataset", data, "--step", 7, "--out", tmp_path / "step.png")
    assert [one["history"][0].flatten().tolist() for one in explained] == [[6, 7]]
    wrong = {
        "categories: store integers": states / 2,
        "are [16], which Discrete(16) does not have": states + 1,
        "but in FrozenLake-v1 it is []": np.ones((200, 5)),
    }
    for number, (message, observations) in enumerate(wrong.items()):
        other = log_machine(tmp_path / f"{number}", observations=observations, actions=actions)
        more = ["--dataset", other, "--out", tmp_path / "no.png"]
        assert message in fails(capsys, "explain", run.folder, *more)
    taxi = make_ppo("Taxi-v4", enhanced_tit(2, **TIT), mask_actions=True)
    run = untrained(tmp_path / "taxi", taxi)
    more = ["--dataset", data, "--out", tmp_path / "no.png"]
    assert "which actions are allowed" in fails(capsys, "explain", run.folder, *more)


def test_forbidden_actions_have_no_value(tmp_path):
    """TorchRL writes the lowest float for them."""
    pytest.importorskip("captum")
    recipe = DQN(
        name="explained",
        env="Taxi-v4",
        backbone=enhanced_tit(2, **TIT),
        mask_actions=True,
        total_steps=40,
        random_steps=20,
    )
    run, page = untrained(tmp_path / "run", recipe), tmp_path / "page.png"
    explain(run.folder, "--out", page, "--step", 1)
    assert imageio.imread(page).shape == PAGE
