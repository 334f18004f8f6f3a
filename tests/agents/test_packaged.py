"""The agents that come with this package."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from huggingface_hub import ModelCard

from torchrl_tit import agents
from torchrl_tit.agents import agent_names, load_agent
from torchrl_tit.agents.folder import CARD, CONTENTS, MANIFEST, read_agent

FOLDER = Path(agents.__file__).parent
NAMES = agent_names()
QUICK = {"CartPole-v1", "Acrobot-v1", "MountainCar-v0"}


def test_they_are_small_and_complete():
    folders = [path for path in FOLDER.iterdir() if path.is_dir() and path.name != "__pycache__"]
    assert sorted(path.name for path in folders) == NAMES
    assert "cartpole" in NAMES
    files = [file for folder in folders for file in folder.iterdir()]
    assert {file.name for file in files} == {*CONTENTS, MANIFEST}
    assert sum(file.stat().st_size for file in files) < 10e6


@pytest.mark.parametrize("name", NAMES)
def test_their_cards_say_what_was_evaluated(name):
    files = read_agent(FOLDER / name)
    card: Any = ModelCard((FOLDER / name / CARD).read_text(encoding="utf-8"))
    evaluation = files.evaluation
    assert len(evaluation["returns"]) == evaluation["episodes"]
    returns = torch.tensor(evaluation["returns"], dtype=torch.float64)
    assert evaluation["mean"] == pytest.approx(returns.mean().item())
    assert evaluation["std"] == pytest.approx(returns.std(correction=0).item())
    [result] = card.data.eval_results
    assert result.metric_value == f"{evaluation['mean']:.2f} +/- {evaluation['std']:.2f}"
    assert card.data.license == "mit"
    assert f'load_agent("{name}")' in card.text
    assert f"# {name}\n" in card.text
    dataset = json.loads(files.recipe).get("dataset", "")
    assert not Path(dataset).is_absolute()


@pytest.mark.parametrize("name", NAMES)
def test_they_act(name):
    """The quick ones repeat the first episodes of their evaluation; the others take steps."""
    agent = load_agent(name)
    if agent.recipe["env"] in QUICK:
        episodes = 2
        before = torch.tensor(agent.evaluation["returns"][:episodes])
        # Not exactly: processors round differently, which can change an action.
        assert agent.evaluate(episodes).mean() == pytest.approx(before.mean().item(), rel=0.15)
    else:
        env = agent.make_env(2, seed=agent.first_seed)
        steps = env.rollout(5, agent.policy, break_when_any_done=False)
        assert steps["action"].isfinite().all()
