"""What every algorithm trains is whole: its policy acts on raw observations, wherever it is."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensordict.nn import set_interaction_type
from tensordict.nn.probabilistic import InteractionType

from recipes.core import runner
from recipes.core.run import Run
from recipes.dqn import DQN
from recipes.ppo import PPO
from recipes.sac import SAC
from tests.agents.runs import packed
from tests.recipes.cql.cql_runs import make_cartpole_data, make_cql, make_discrete_cql, tit
from tests.recipes.dataset_runs import train
from tests.recipes.decision_transformer.sequence_runs import SMALL, make_dt, make_odt
from tests.recipes.offline.offline_runs import BC, IQL, TD3BC, make
from torchrl_tit.agents import load_agent
from torchrl_tit.agents.folder import WEIGHTS
from torchrl_tit.export.comparison import COPIES, compare
from torchrl_tit.export.parts import read_parts
from torchrl_tit.export.policy import export_policy
from torchrl_tit.export.program import make_program
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.settings.networks import decision_transformer

ONLINE: dict[str, Any] = {
    "backbone": tit(3),
    "name": "small",
    "evaluation_episodes": 2,
    "env_settings": ("max_episode_steps=20",),
}
STEPS: dict[str, Any] = {"total_steps": 60, "steps_per_batch": 20, "random_steps": 20}
OFFLINE: dict[str, Any] = {"total_updates": 3, "evaluation_episodes": 2, "backbone": tit(3)}
NORMALIZED: dict[str, Any] = {**OFFLINE, "normalize_observations": True}
SEQUENCES: dict[str, Any] = {"target_returns": (20.0,), "evaluation_episodes": 2}


def ppo(folder, env):
    short: dict[str, Any] = {
        "total_steps": 96,
        "steps_per_batch": 32,
        "minibatch_size": 16,
        "epochs": 2,
    }
    return PPO(env=env, **ONLINE, **short, normalize_observations=True)


def discrete_dt(folder):
    return make_dt(
        folder,
        dataset=str(make_cartpole_data(folder)),
        env="CartPole-v1",
        backbone=decision_transformer(**SMALL),
        action_space="discrete",
        iterations=1,
        updates_per_iteration=3,
        **SEQUENCES,
    )


# A recipe, and the noise with which its actions are drawn.
RECIPES: dict[str, Any] = {
    "ppo": (partial(ppo, env="CartPole-v1"), "gumbel"),
    "ppo, continuous": (partial(ppo, env="Pendulum-v1"), "standard_normal"),
    "sac": (lambda folder: SAC(env="Pendulum-v1", **ONLINE, **STEPS), "standard_normal"),
    "dqn": (lambda folder: DQN(env="CartPole-v1", **ONLINE, **STEPS), None),
    "bc": (partial(make, BC, **NORMALIZED), "standard_normal"),
    "bc, discrete": (partial(make, BC, env="CartPole-v1", **NORMALIZED), "gumbel"),
    "iql": (partial(make, IQL, **NORMALIZED), "standard_normal"),
    "td3bc": (partial(make, TD3BC, **NORMALIZED), None),
    "cql": (partial(make_cql, **NORMALIZED), "standard_normal"),
    "discrete-cql": (partial(make_discrete_cql, **NORMALIZED), None),
    "dt": (partial(make_dt, iterations=1, updates_per_iteration=3, **SEQUENCES), None),
    "dt, discrete": (discrete_dt, "gumbel"),
    "odt": (partial(make_odt, rounds=1, updates_per_round=2, **SEQUENCES), "standard_normal"),
}


@pytest.fixture(scope="module", params=RECIPES)
def trained(request, tmp_path_factory):
    """A run, loaded as an agent."""
    folder = tmp_path_factory.mktemp("run")
    make_recipe, noise = RECIPES[request.param]
    run = train(make_recipe(folder), folder / "run")
    agent = load_agent(run.folder)
    agent.policy.requires_grad_(False)
    return SimpleNamespace(name=request.param, run=run, agent=agent, noise=noise)


def test_the_environment_leaves_observations_as_they_are(trained):
    """So what a policy needs to know of them is in the policy."""
    recipe = trained.run.recipe
    env = trained.agent.make_env(1, seed=3)
    step = env.reset()
    env.close()
    task = gymnasium.make(recipe.env)
    task.reset(seed=3)  # as the environment's constructor did
    raw = task.reset()[0].astype(np.float32)
    newest = step.get("history", step.get(("sequence", "observation"), None))[0, -1]
    for seen in (step["observation"][0], newest):
        assert np.array_equal(seen.numpy(), raw)
    statistics = [m for m in trained.agent.policy.modules() if isinstance(m, NormalizedFrames)]
    assert len(statistics) == (trained.name not in ("sac", "dqn"))
    for frames in statistics:
        assert (frames.variance < 0.9).any()


def test_an_agent_acts_as_its_run_was_evaluated(trained, tmp_path):
    with Run.open(trained.run.folder) as run:
        run.save_evaluation(runner.evaluate(run))
    agent = load_agent(packed(run.folder, tmp_path / "agent"))
    assert agent.evaluate().tolist() == pytest.approx(agent.evaluation["returns"], rel=1e-5)

    saved = load_file(tmp_path / "agent" / WEIGHTS)
    _, algorithm, _ = runner.load_trained(run)
    everything = {tuple(x.flatten().tolist()) for x in algorithm.model.state_dict().values()}
    assert all(tuple(weight.flatten().tolist()) in everything for weight in saved.values())
    assert len(saved) == len(algorithm.policy.state_dict())


@pytest.mark.parametrize("step_by_step", [False, True], ids=["windows", "steps"])
def test_its_program_acts_as_the_agent(trained, step_by_step):
    policy, env = trained.agent.policy, trained.agent.make_env(COPIES)
    program = make_program(
        read_parts(policy, env), step_by_step=step_by_step, sample=trained.noise is not None
    )
    assert program.noise == trained.noise
    # In ONNX, inputs and outputs share their names.
    assert not {*program.inputs} & {*program(program.examples(1))}
    assert compare(program, program, policy, env, observations=60) < 1e-5
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("step_by_step", [False, True], ids=["windows", "steps"])
@pytest.mark.parametrize("format", ["pt2", "onnx"])
def test_its_files_act_as_the_agent(trained, format, step_by_step, tmp_path):
    """Writing compares them with the agent on observations as the task gives them."""
    pytest.importorskip("onnxruntime")
    facts = export_policy(
        trained.agent.policy,
        trained.agent.make_env,
        Path(tmp_path, f"policy.{format}"),
        step_by_step=step_by_step,
    )
    assert facts["difference"] < 1e-5


def test_a_cloned_policy_acts_on_raw_histories(tmp_path):
    """As the same network without statistics does on observations normalised by hand."""
    run = train(make(BC, tmp_path, **{**NORMALIZED, "total_updates": 30}), tmp_path / "run")
    policy = load_agent(run.folder).policy
    trained: Any = runner.load_trained(run)[1]
    trained.prepare(30, tmp_path)
    mean, std = trained.load_data().observation_statistics()
    raw = trained.buffer.sample()
    by_hand = raw.clone()
    by_hand["history"] = (raw["history"] - mean) / (std + 1e-3)
    (frames,) = (m for m in trained.policy.eval().modules() if isinstance(m, NormalizedFrames))
    frames.set_statistics(torch.zeros(11), torch.full((11,), 1 - 1e-3))
    errors = []
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        for acts, batch in ((policy, raw), (trained.policy, by_hand)):
            errors.append(acts(batch.clone())["action"] - raw["action"])
    torch.testing.assert_close(*errors, rtol=1e-4, atol=1e-5)
    assert errors[0].std() > 1e-3
