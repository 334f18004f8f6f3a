"""`export`, from a run folder to a file."""

import json

import pytest
import torch

from recipes.cli import main
from recipes.core.run import Run
from recipes.ppo import PPO
from tests.recipes.commands import fails
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import mlp

RECIPE = PPO(
    name="ppo/small",
    env="CartPole-v1",
    env_settings=("max_episode_steps=9",),
    backbone=mlp(2, hidden_dim=4),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return untrained(tmp_path_factory.mktemp("runs") / "run", RECIPE).folder


def test_a_run_becomes_a_file(run, tmp_path, capsys):
    file = tmp_path / "agent.pt2"
    main(["export", str(run), "--out", str(file), "--step-by-step"])
    said, written = capsys.readouterr().out.splitlines()
    inputs = "observation, is_init, tokens -> action, logits, next_tokens"
    assert said.startswith(f"{run}: {inputs}; differs by ")
    assert written == f"written to {file}"
    about = {"torchrl_tit.json": ""}
    torch.export.load(file.open("rb"), extra_files=about)
    facts = json.loads(about["torchrl_tit.json"])
    assert facts["task"] == {"id": "CartPole-v1", "max_episode_steps": 9}
    assert (facts["recipe"], facts["steps"], facts["num_frames"]) == ("ppo/small", 0, 2)


def test_bad_input(run, tmp_path, capsys):
    def error(*words):
        return fails(capsys, "export", *words)

    out = ["--out", tmp_path / "agent.pt2"]
    (tmp_path / "empty").mkdir()
    Run.create(tmp_path / "new", RECIPE)
    assert "holds no checkpoint: train the run first" in error(tmp_path / "new", *out)
    assert "neither an agent nor a run" in error(tmp_path / "empty", *out)
    assert "there is no agent or folder 'nobody'" in error("nobody", *out)
    assert "tells no format" in error(run, "--out", tmp_path / "agent")
    assert "invalid choice: 'torchscript'" in error(run, *out, "--format", "torchscript")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "new"]
