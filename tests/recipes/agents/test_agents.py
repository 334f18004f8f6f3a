"""From a run to an agent and back: every algorithm's policy acts as it did in the run."""

import json
import os
from dataclasses import replace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save
from torchrl.envs import GymEnv, TransformedEnv

from recipes.bc import BC
from recipes.decision_transformer import DT
from recipes.ppo import PPO
from recipes.sac import SAC
from recipes.tools.agents import pack
from tests.agents.runs import make_run, packed
from torchrl_tit import load_agent
from torchrl_tit.agents import AgentError, TrainedAgent
from torchrl_tit.agents.folder import CARD, CONTENTS, RECIPE, WEIGHTS, write_agent
from torchrl_tit.evaluation_file import EVALUATION
from torchrl_tit.modules import acting
from torchrl_tit.settings.networks import dt_tit, lstm, mlp

SMALL = mlp(hidden_dim=8)
EPISODES: dict[str, Any] = {
    "evaluation_episodes": 2,
    "evaluation_seed": 5,
    "env_settings": ("max_episode_steps=15",),
}
DATA: dict[str, Any] = {"dataset": "/data/of/mine/rollouts.hdf5", **EPISODES}

RECIPES: dict[str, Any] = {
    "history": None,  # PPO's with an Enhanced_TIT
    "state": PPO(env="CartPole-v1", backbone=lstm(hidden_dim=8), hide_velocities=True, **EPISODES),
    "squashed": SAC(env="Pendulum-v1", backbone=SMALL, critic_hidden=(8,), **EPISODES),
    "statistics": BC(env="Pendulum-v1", backbone=SMALL, normalize_observations=True, **DATA),
    "returns-to-go": DT(
        env="CartPole-v1",
        backbone=dt_tit(num_frames=3, embed_dim=8, num_blocks=1),
        action_space="discrete",
        target_returns=(30.0, 20.0),
        **DATA,
    ),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def agent(run, tmp_path_factory):
    return packed(run, tmp_path_factory.mktemp("agents") / "cart.pole-2")


def test_a_run_is_an_agent_too(run):
    evaluation = json.loads((run / "evaluation.json").read_text())
    loaded = load_agent(run)
    assert loaded.evaluation == evaluation
    assert loaded.evaluate().tolist() == evaluation["returns"]
    assert loaded.evaluate(1, seed=6).tolist() == evaluation["returns"][1:2]  # the same episode


def test_no_places_are_packed(tmp_path):
    recipe = replace(RECIPES["statistics"])
    files, _ = pack(make_run(tmp_path / "run", recipe), "small")
    assert json.loads(files[RECIPE])["dataset"] == "rollouts.hdf5"
    assert json.loads(files[EVALUATION])["dataset"] == "rollouts.hdf5"
    assert not any(b"/data/of" in content for content in files.values())
    named = replace(recipe, dataset="hopper-medium-v2")
    files, _ = pack(make_run(tmp_path / "named", named), "small")
    assert json.loads(files[RECIPE])["dataset"] == "hopper-medium-v2"


def test_the_better_target_return_is_aimed_for(tmp_path):
    run = make_run(tmp_path / "run", RECIPES["returns-to-go"])
    evaluation = json.loads((run / "evaluation.json").read_text())
    for target in (30.0, 20.0):
        better = {**evaluation, "target_return": target}
        (run / "evaluation.json").write_text(json.dumps(better))
        loaded = load_agent(packed(run, tmp_path / f"agent-{target:g}"))
        assert loaded.make_env(2).reset()["target_return"].tolist() == [[target]] * 2
    assert loaded.make_env(1, target_return=7.0).reset()["target_return"].item() == 7


@pytest.mark.parametrize("kind", ["history", "state", "returns-to-go"])
def test_transforms_for_an_environment_of_ones_own(kind, tmp_path):
    loaded = load_agent(make_run(tmp_path / "run", RECIPES[kind]))
    ours = loaded.make_env(1)
    for _ in range(2):  # the second are not the first's
        own = GymEnv("CartPole-v1", categorical_action_encoding=True)
        own = TransformedEnv(own, loaded.make_transforms())
        steps, expected = (
            env.rollout(8, loaded.policy, auto_reset=False, tensordict=env.reset(seed=5))
            for env in (own, ours)
        )
        for key in ("action", "observation", ("next", "reward")):
            assert torch.equal(steps[key], expected[key][0])


def test_what_an_agent_knows(agent, run):
    loaded = load_agent(agent)
    assert isinstance(loaded, TrainedAgent)
    assert (loaded.name, loaded.steps, loaded.first_seed) == (str(agent), 7, 5)
    assert loaded.recipe["env"] == "CartPole-v1"
    assert loaded.recipe["backbone"]["frame"]["encoder"] == "inner"
    assert loaded.evaluation == json.loads((run / "evaluation.json").read_text())
    assert loaded.versions == json.loads((run / "versions.json").read_text())
    assert not loaded.policy.training
    env = loaded.make_env(4, seed=0)
    with acting(loaded.policy):
        steps = env.rollout(5, loaded.policy, break_when_any_done=False)
    assert steps["history"].shape == (4, 5, 2, 4)
    with pytest.raises(ValueError, match="episodes must be at least 1, not 0"):
        loaded.evaluate(0)


def test_loading_leaves_the_callers_threads_alone(run, agent):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(before + 1)
        load_agent(run)
        load_agent(agent)
        assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)


def test_an_evaluation_of_an_older_checkpoint_is_not_the_agents(tmp_path):
    folder = make_run(tmp_path / "run")
    evaluation = json.loads((folder / "evaluation.json").read_text())
    (folder / "evaluation.json").write_text(json.dumps({**evaluation, "steps": 3}))
    assert load_agent(folder).evaluation == {}
    assert load_agent(folder).first_seed == 5  # the recipe's
    for content in (json.dumps({**evaluation, "steps": 3}), '{"steps": 7}', "no JSON", "[]"):
        (folder / "evaluation.json").write_text(content)
        with pytest.raises(AgentError, match=r"no evaluation of its newest .* 7: run `evaluate"):
            pack(folder, "small")


def rewritten(agent, folder, **changes):
    """The same agent with other contents of some files, and checksums that fit them."""
    contents = {name: (agent / name).read_bytes() for name in CONTENTS}
    write_agent(folder, {**contents, **changes}, steps=7)
    return folder


def test_weights_that_do_not_fit(agent, tmp_path):
    wider = rewritten(agent, tmp_path / "wider", **{WEIGHTS: save({"weight": torch.zeros(2)})})
    with pytest.raises(AgentError, match=r"weights do not fit recipe.json .*Missing key") as error:
        load_agent(wider)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (lambda x: x.double(), r"head\.0\.bias is torch.float64, not torch.float32"),
        (lambda x: x * float("nan"), r"head\.0\.bias has entries that are not finite"),
    ],
)
def test_weights_of_another_type_or_that_are_no_numbers(agent, tmp_path, changed, reason):
    weights = load_file(agent / WEIGHTS)
    (name,) = [name for name in weights if name.endswith("head.0.bias")]
    weights[name] = changed(weights[name])
    folder = rewritten(agent, tmp_path / "changed", **{WEIGHTS: save(weights)})
    with pytest.raises(AgentError, match=rf"weights do not fit recipe.json .*{reason}"):
        load_agent(folder)


def test_an_algorithm_is_known_by_its_name_only(agent, tmp_path):
    fields = json.loads((agent / RECIPE).read_text()) | {"algorithm": "os.system"}
    with pytest.raises(ValueError, match=r"recipe.json cannot be read .*unknown algorithm"):
        load_agent(rewritten(agent, tmp_path / "agent", **{RECIPE: json.dumps(fields).encode()}))


def test_names_on_cards(run):
    with pytest.raises(AgentError, match=r"name must be letters, digits.* not 'a: b'"):
        pack(run, "a: b")
    with pytest.raises(AgentError, match="license must be letters"):
        pack(run, "a", license="MIT License")


def test_a_card_imports_the_modules_of_its_own_parts(run, monkeypatch):
    """By their names alone: a path names a machine."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", os.pathsep.join(["pack_a.parts", "/home/me/mine.py"]))
    card = pack(run, "a")[0][CARD].decode()
    assert "\nimport pack_a.parts  # not in torchrl-tit\nimport mine  # not in" in card
    assert "/home" not in card
