"""What `data collect` can be told to make, and what it refuses."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torchrl.modules import MLP

from recipes.cli import main
from recipes.collect import collect
from recipes.collect.sac import SAC
from tests.recipes.collect.collected import (
    CARTPOLE,
    PENDULUM,
    attributes,
    read,
)
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.envs import make_env


def test_the_agent_of_a_finished_run(cartpole: Path, tmp_path: Path) -> None:
    """Without the data that it was trained on, so a mixed set cannot be."""
    run = cartpole / "training"
    settings = replace(CARTPOLE, agent=str(run), sets=("expert",), medium_return=None)
    collect(settings, tmp_path / "c")

    noted = attributes(tmp_path / "c" / "expert.hdf5")
    assert noted["algorithm"] == "PPO"
    assert noted["agent_steps"] == max(checkpoint_steps(run / "checkpoints"))
    assert noted["agent_return"] >= 180
    # The same weights and seeds as when it was trained for its data.
    for name, array in read(cartpole / "expert.hdf5").items():
        np.testing.assert_array_equal(array, read(tmp_path / "c" / "expert.hdf5")[name])

    with pytest.raises(ValueError, match="has kept nothing of what it saw"):
        collect(replace(settings, sets=("mixed",)), tmp_path / "m")
    with pytest.raises(ValueError, match="expert_return 1000 is not reached by the run in"):
        collect(replace(settings, expert_return=1000), tmp_path / "n")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"transitions": 0}, "transitions must be at least 1, not 0"),
        ({"total_steps": 0}, "total_steps must be at least 1"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"evaluation_interval": 0}, "evaluation_interval must be at least 1"),
        ({"evaluation_episodes": 0}, "evaluation_episodes must be at least 1"),
        ({"checkpoint_interval": 0}, "checkpoint_interval must be at least 1"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"sets": ()}, "sets must be some of random, mixed, medium, expert"),
        ({"sets": ("random", "random")}, "each once, not"),
        ({"sets": ("good",)}, "sets must be some of"),
        ({"medium_return": None}, "medium and expert would be the same agent: give medium_return"),
        ({"medium_return": float("nan")}, "medium_return must be finite, not nan"),
        ({"expert_return": -3000}, "expert_return -3000 must be above medium_return -2000"),
        ({"env": "Pendulun-v1"}, "'Pendulun-v1' cannot be made: .*Did you mean: `Pendulum`"),
        ({"env": "CartPole-v1"}, "sac needs continuous actions, but those of CartPole-v1 are disc"),
        ({"env": "Blackjack-v1", "sets": ("random",)}, r"Blackjack-v1 has observations Tuple\("),
        ({"agent": "ppo/pendulum/mlp"}, "unknown recipe 'ppo/pendulum/mlp': did you mean"),
        ({"agent": "ppo/cartpole/mlp"}, "is of the task CartPole-v1, not Pendulum-v1"),
        ({"agent": "dt/hopper-medium-v2/dt"}, "collected with sac or a PPO recipe"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_made(
    fields: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        collect(replace(PENDULUM, **fields), tmp_path / "c")
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"random_steps": 120}, "random_steps 120 are no whole batches of steps_per_batch 50"),
        ({"gamma": 1.5}, "gamma must be at most 1"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
    ],
)
def test_settings_of_sac_that_cannot_be(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SAC(**fields)


def test_folders_that_are_not_gone_on_with(pendulum: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds data of other settings \(seed: 0 -> 1\)"):
        collect(replace(PENDULUM, seed=1), pendulum)
    # The expert is the agent at the end of 600 steps.
    with pytest.raises(ValueError, match=r"other settings \(total_steps: 600 -> 700\)"):
        collect(replace(PENDULUM, total_steps=700), pendulum)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="has something else in it"):
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

    with pytest.raises(SystemExit) as stop:
        main([*words, "--out", str(tmp_path / "c"), "--seed", "1"])
    assert stop.value.code == 2
    assert "holds data of other settings" in capsys.readouterr().err


def test_critics_start_as_they_were_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a single one, TorchRL's loss makes copies whose weights it draws anew."""
    built: list[dict[str, Tensor]] = []

    def make_mlp(*sizes: int, **layers: Any) -> MLP:
        mlp = MLP(*sizes, **layers)
        built.append({name: weight.clone() for name, weight in mlp.state_dict().items()})
        return mlp

    with closing(make_env("Pendulum-v1", 1, clip_actions=False)) as env:
        actor = PENDULUM.sac.make_actor(env)
        monkeypatch.setattr("recipes.collect.sac.MLP", make_mlp)
        loss = PENDULUM.sac.make_loss(env, actor)
    stacked = loss.qvalue_network_params["module"].flatten_keys(".")
    assert len(built) == 2
    for name, weights in stacked.items():
        assert torch.equal(weights, torch.stack([critic[name] for critic in built]))
        assert not torch.equal(*weights)
