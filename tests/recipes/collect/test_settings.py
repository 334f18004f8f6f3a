"""Settings of `data collect`: agents, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Space

from recipes.cli import main
from recipes.core.numbers import number
from recipes.core.recipe_json import recipe_to_json
from recipes.sac import SAC
from recipes.tools.collect import Collection
from recipes.tools.collect.agents import AgentInTraining, find_agent
from recipes.tools.collect.collect import collect
from tests.recipes.collect.collected import CARTPOLE, CARTPOLE_RECIPE, PENDULUM, attributes, read
from tests.recipes.commands import fails
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.datasets import TaskSpaces, load_episodes, task_spaces
from torchrl_tit.settings.networks import mlp


def test_the_agent_of_a_finished_run(cartpole: Path, tmp_path: Path) -> None:
    """Without the data that it was trained on, so there is no mixed set."""
    run = cartpole / "training"
    settings = replace(CARTPOLE, agent=str(run), sets=("expert",), medium_return=None)
    collect(settings, tmp_path / "c")

    noted = attributes(tmp_path / "c" / "expert.hdf5")
    assert noted["algorithm"] == "PPO"
    assert noted["agent_steps"] == max(checkpoint_steps(run / "checkpoints"))
    assert noted["agent_return"] >= 130
    # The same weights and seeds as when it was trained for its data.
    for name, array in read(cartpole / "expert.hdf5").items():
        np.testing.assert_array_equal(array, read(tmp_path / "c" / "expert.hdf5")[name])

    with pytest.raises(ValueError, match="has not kept what it saw, so there is no mixed set"):
        collect(replace(settings, sets=("mixed",)), tmp_path / "m")
    with pytest.raises(ValueError, match="expert_return 1000 is not reached by the run in"):
        collect(replace(settings, expert_return=1000), tmp_path / "n")
    both = replace(settings, sets=("medium", "expert"), medium_return=100, transitions=50)
    with pytest.warns(UserWarning, match=r"medium and expert are the same agent: after \d+ steps"):
        collect(both, tmp_path / "both")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"transitions": 0}, "transitions must be at least 1, not 0"),
        ({"evaluation_interval": 0}, "evaluation_interval must be at least 1"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"sets": ()}, "sets must be some of random, mixed, medium, expert"),
        ({"sets": ("random", "random")}, "each once, not"),
        ({"sets": ("good",)}, "field .sets. is .*good"),
        ({"medium_return": None}, "medium and expert would be the same agent: give medium_return"),
        ({"medium_return": float("nan")}, "medium_return must be at least -1000000000.0, not nan"),
        ({"threads": 5000}, "threads must be at most 1024, not 5000"),
        ({"expert_return": -3000}, "expert_return -3000 must be above medium_return -2000"),
        ({"env": "Pendulun-v1"}, "'Pendulun-v1' cannot be made: .*Did you mean: `Pendulum`"),
        (
            {"env": "CartPole-v1"},
            "sac needs continuous .*, but those of CartPole-v1 are Categorical.*: use a ppo recipe",
        ),
        ({"env": "Blackjack-v1", "sets": ("random",)}, r"Blackjack-v1 has observations Tuple\("),
        ({"agent": "ppo/pendulum/mlp"}, "unknown recipe 'ppo/pendulum/mlp': did you mean"),
        ({"agent": "ppo/cartpole/mlp"}, "is of the task CartPole-v1, not Pendulum-v1"),
        ({"agent": "dqn/cartpole/mlp"}, "of dqn, whose policy has no distribution to sample"),
        ({"agent": "dt/hopper-medium-v2/dt"}, "trained on a data set, not in its task: choose sac"),
    ],
)
def test_impossible_settings_are_refused_before_anything_is_made(
    fields: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        collect(replace(PENDULUM, **fields), tmp_path / "c")
    assert not (tmp_path / "c").exists()


VECTOR, CHOICE = Box(-1, 1, (4,)), Discrete(2)


@pytest.mark.parametrize(
    ("observation", "action", "supported"),
    [
        (VECTOR, Box(-1, 1, (2,)), True),
        (Box(0, 255, (1, 8, 8), np.uint8), CHOICE, True),
        (Box(0, 255, (8, 8, 3), np.uint8), CHOICE, False),
        (Box(0, 255, (8, 8, 8), np.uint8), CHOICE, False),
        (Box(0, 9, (4,), np.int64), CHOICE, False),
        (VECTOR, Discrete(2, start=1), False),
        (VECTOR, Box(-1, 1, (2, 2)), False),
        (VECTOR, Box(0, 3, (2,), np.int64), False),
        (VECTOR, MultiDiscrete([2, 3]), False),
    ],
)
def test_what_is_recorded_as_the_task_has_it(
    observation: Space[Any], action: Space[Any], supported: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    spaces = TaskSpaces(observation, action, "Some-v0")
    monkeypatch.setattr("recipes.tools.collect.collect.task_spaces", lambda name: spaces)
    words = "unknown recipe" if supported else "data can be collected of one array or image"
    with pytest.raises(ValueError, match=words):
        collect(replace(PENDULUM, agent="absent"), Path("absent"))


def test_recipes_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "recipe.json"
    settings = replace(CARTPOLE, agent=str(path))
    with pytest.raises(FileNotFoundError, match="recipe"):
        collect(settings, tmp_path / "c")
    for change, message in (
        ({"hide_velocities": True}, "hides the velocities"),
        ({"env_settings": ("max_episode_steps=9",)}, "changes the task with env_settings"),
    ):
        path.write_text(recipe_to_json(replace(CARTPOLE_RECIPE, **change)))
        with pytest.raises(ValueError, match=message):
            collect(settings, tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_sac_is_named_for_short(tmp_path: Path) -> None:
    settings = replace(PENDULUM, seed=3, threads=2)
    agent = find_agent(settings, tmp_path / "training", task_spaces("Pendulum-v1").action)
    assert agent is not None
    assert agent.recipe == SAC(
        name="sac",
        env="Pendulum-v1",
        backbone=mlp(hidden_dim=256, activation="relu"),
        total_steps=400,
        seed=3,
        threads=2,
        checkpoint_interval=150,
    )
    assert not (tmp_path / "training").exists()


def test_a_recipe_is_trained_no_longer_than_it_says(tmp_path: Path) -> None:
    """And in one process, whose batches continue one another."""
    recipe = replace(CARTPOLE_RECIPE, total_steps=1000, collectors=2)
    (tmp_path / "short.json").write_text(recipe_to_json(recipe))
    settings = replace(CARTPOLE, agent=str(tmp_path / "short.json"))
    for total_steps, final_step in ((8192, 1024), (512, 512)):
        agent = find_agent(
            replace(settings, total_steps=total_steps), tmp_path, task_spaces("CartPole-v1").action
        )
        assert isinstance(agent, AgentInTraining)
        assert agent.last_step == final_step
        assert agent.recipe == replace(CARTPOLE_RECIPE, total_steps=1000, checkpoint_interval=768)


def test_folders_that_cannot_be_resumed(
    pendulum: Path, pendulum_settings: Collection, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"holds data of other settings \(seed: 0 -> 1\)"):
        collect(replace(pendulum_settings, seed=1), pendulum)
    # The expert is the agent at the end of 400 steps.
    with pytest.raises(ValueError, match=r"other settings \(total_steps: 400 -> 500\)"):
        collect(replace(pendulum_settings, total_steps=500), pendulum)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="holds something other than collected data"):
        collect(PENDULUM, tmp_path)
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(ValueError, match=r"settings.json cannot be read"):
        collect(PENDULUM, tmp_path)


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data", "collect", "CartPole-v1", "--sets", "random", "--transitions", "50"]
    main([*words, "--out", str(tmp_path / "c")])
    assert capsys.readouterr().out.startswith("random: ")
    noted = attributes(tmp_path / "c" / "random.hdf5")
    assert " data collect CartPole-v1 --sets random --transitions 50 --out " in noted["command"]

    main(["data", "info", str(tmp_path / "c" / "random.hdf5"), "--env", "CartPole-v1"])
    assert "env_id        CartPole-v1" in capsys.readouterr().out

    assert "holds data of other settings" in fails(
        capsys, *words, "--out", str(tmp_path / "c"), "--seed", "1"
    )


@pytest.mark.parametrize("transitions", [100, 3])
def test_parts_of_episodes_do_not_count_in_the_summary(transitions: int, tmp_path: Path) -> None:
    settings = Collection(env="CartPole-v1", sets=("random",), transitions=transitions)
    [line] = collect(settings, tmp_path / "c")
    episodes = load_episodes(tmp_path / "c" / "random.hdf5")
    assert episodes.is_whole.all() if transitions == 100 else not episodes.is_whole.any()
    mean = number(episodes.returns.mean().item()) if transitions == 100 else "unknown"
    assert f"mean return of whole ones {mean}:" in line
