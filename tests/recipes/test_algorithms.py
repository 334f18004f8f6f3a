"""Every algorithm trains, resumes, and its policy acts on raw observations, wherever it is."""

from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from recipes.core import runner
from recipes.core.metrics import read_metrics
from recipes.core.run import Run
from tests.agents.runs import packed
from tests.recipes.small import RECIPES, assert_resumes_bit_for_bit, make_algorithm, train
from torchrl_tit.agents import load_agent
from torchrl_tit.agents.folder import WEIGHTS
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.export.comparison import COPIES, compare
from torchrl_tit.export.parts import read_parts
from torchrl_tit.export.policy import export_policy
from torchrl_tit.export.program import make_program
from torchrl_tit.frames import NormalizedFrames

NOISE = {
    "standard_normal": [
        "ppo, continuous",
        "ppo, smooth",
        "sac",
        "sac, mamba2",
        "bc",
        "iql",
        "iql, gru",
        "cql",
        "cql, mingru",
        "odt",
    ],
    "gumbel": [
        "ppo",
        "ppo, contrastive",
        "ppo, novelty",
        "bc, discrete",
        "iql, discrete",
        "dt, discrete",
    ],
}
"""With which the actions of policies are drawn that draw them."""


@pytest.fixture(scope="module", params=RECIPES)
def trained(request, tmp_path_factory):
    """A run, loaded as an agent."""
    folder = tmp_path_factory.mktemp("run")
    recipe = RECIPES[request.param](folder)
    make_algorithm(recipe).check()
    run = train(recipe, folder / "run")
    agent = load_agent(run.folder)
    agent.policy.requires_grad_(False)
    noise = next((noise for noise, names in NOISE.items() if request.param in names), None)
    return SimpleNamespace(name=request.param, run=run, agent=agent, noise=noise)


def test_all_networks_are_trained_and_all_terms_are_logged(trained):
    recipe = trained.run.recipe
    torch.manual_seed(recipe.seed)
    algorithm = make_algorithm(recipe)
    before = algorithm.model.state_dict()
    _, state = load_checkpoint(trained.run.checkpoints)
    changed = {network_of(n) for n, w in state["networks"].items() if not torch.equal(w, before[n])}
    assert changed >= {network_of(name) for name, _ in algorithm.model.named_parameters()}
    if recipe.algorithm != "dqn":  # whose target is copied after many steps
        assert changed >= {
            network_of(n) for n in before if n.startswith("target_") and "_params" in n
        }
    rows = read_metrics(trained.run.folder / "metrics.csv")
    for column in {"return_mean", *algorithm.columns} - set(algorithm.optional_columns):
        values = np.array([row[column] for row in rows])
        assert np.isfinite(values).any(), column
        assert not np.isinf(values).any(), column


def network_of(name):
    """The network that a weight belongs to."""
    return name.partition("_params")[0].partition(".")[0]


def test_a_run_on_data_resumes_bit_for_bit(trained, tmp_path):
    """That of others is in test_intervals.py: they begin new episodes."""
    if not trained.run.recipe.offline:
        pytest.skip("no run on data")
    assert_resumes_bit_for_bit(trained.run, tmp_path / "cut")


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
    assert len(statistics) == 1
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
    # Where an episode begins, the state is not read, whatever became of it.
    first = program.examples(2)
    if program.state:
        first["is_init"] = torch.ones(2, dtype=torch.bool)
        floats = [name for name in program.state if first[name].is_floating_point()]
        lost = {name: torch.full_like(first[name], torch.nan) for name in floats}
        expected = program(first)
        for name, value in program(first | lost).items():
            assert torch.equal(value, expected[name]), name


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
