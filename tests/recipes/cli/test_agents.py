"""`play`, `share` and `export` on the command line."""

import json

import imageio.v3 as imageio
import pytest
import torch

from recipes.cli import main
from recipes.core.numbers import number, plus_minus
from tests.agents.runs import make_run
from tests.recipes.commands import fails
from torchrl_tit.agents import agent_names, load_agent
from torchrl_tit.agents.folder import CARD, WEIGHTS


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "run")


def test_the_list_of_agents(capsys):
    main(["play"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == agent_names()
    [cartpole] = [line for line in lines if line.startswith("cartpole:")]
    assert "CartPole-v1, return 500 ± 0 over 100 episodes" in cartpole


def test_an_agent_plays_and_is_filmed(run, tmp_path, capsys):
    pytest.importorskip("pygame")
    main(["share", str(run), "--out", str(tmp_path / "agent")])
    assert capsys.readouterr().out.startswith(f"written to {tmp_path / 'agent'}: 0.0")
    evaluation = json.loads((run / "evaluation.json").read_text())
    for source in (tmp_path / "agent", run):
        main(["play", str(source), "--episodes", "3"])
        [line] = capsys.readouterr().out.splitlines()
        mean = f"{plus_minus(evaluation['mean'], evaluation['std'])} over 3"
        expected = f"return {mean} episodes of CartPole-v1; its evaluation: {mean}"
        assert line == f"{source}: {expected}"
    film = tmp_path / "film.gif"
    main(["play", str(tmp_path / "agent"), "--out", str(film), "--seed", "6"])
    returned = evaluation["returns"][1]  # of the second episode, whose seed is 5 + 1
    assert f"return {number(returned)} over 1 episode of" in capsys.readouterr().out
    shown = [imageio.immeta(film, index=i)["duration"] for i in range(len(imageio.imread(film)))]
    assert sum(shown) == 20 * (returned + 1)  # a picture a step and one of the end, at 50 a second
    assert f"{film} exists already" in fails(capsys, "play", run, "--out", film)


def test_the_name_on_the_card(run, tmp_path, capsys):
    main(["share", str(run), "--out", str(tmp_path / "some_agent"), "--license", "mit"])
    card = (tmp_path / "some_agent" / CARD).read_text()
    assert "\n# some_agent\n" in card
    assert "\nlicense: mit\n" in card
    other = tmp_path / "new" / "other"  # in a folder that is not there yet
    main(["share", str(run), "--out", str(other), "--name", "mine"])
    card = (other / CARD).read_text()
    assert "\n# mine\n" in card
    assert "license" not in card
    assert load_agent(other).steps == 7


def test_a_folder_of_another_is_not_written_into_and_changed_weights_are_named(
    run, tmp_path, capsys
):
    agent = tmp_path / "agent"
    main(["share", str(run), "--out", str(agent)])
    assert "exists already" in fails(capsys, "share", run, "--out", agent)
    content = (agent / WEIGHTS).read_bytes()
    (agent / WEIGHTS).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert "model.safetensors was changed after it was written" in fails(capsys, "play", agent)


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
    assert facts["task"] == {"id": "CartPole-v1", "max_episode_steps": 20}
    assert (facts["recipe"], facts["steps"], facts["num_frames"]) == ("ppo/cartpole/small", 7, 2)
