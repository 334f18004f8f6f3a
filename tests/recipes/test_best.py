"""The weights with the highest return are kept, and evaluated on new episodes."""

import json
from dataclasses import replace

import pytest
import torch
from torch import nn

from recipes.cli import main
from recipes.core.progress import EPISODES, Best
from recipes.core.runner import evaluate, load_trained
from recipes.dqn import DQN
from recipes.ppo import PPO
from tests.recipes.small import train
from tests.recipes.states import assert_same
from torchrl_tit import load_agent
from torchrl_tit.agents import AgentError
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.settings.networks import mlp

RECIPE = PPO(
    env="CartPole-v1",
    backbone=mlp(hidden_dim=8),
    total_steps=1024,
    steps_per_batch=256,
    num_envs=16,
    minibatch_size=64,
    epochs=1,
    learning_rate=0.02,
    checkpoint_interval=256,
    evaluation_episodes=2,
    compile="off",
)


def test_the_weights_with_the_highest_return_are_kept():
    layer = nn.Linear(1, 1, bias=False)
    best = Best(layer)

    def see(step, value, returns):
        nn.init.constant_(layer.weight, value)
        best.add_episodes(step, returns)

    see(10, 1.0, [5.0] * (EPISODES - 1))
    assert not best.state_dict()["networks"]  # too few episodes
    see(20, 2.0, [5.0])
    see(30, 3.0, [4.0])
    see(40, 4.0, [])
    state = best.state_dict()
    assert (best.step, best.return_mean) == (20, 5.0)
    assert state["networks"]["weight"].item() == 2.0

    restored = Best(layer)
    restored.load_state_dict(state)
    for one in (best, restored):
        nn.init.constant_(layer.weight, 5.0)
        one.add_episodes(50, [6.0])  # 18 fives, a four and a six: as high as before
        assert (one.step, one.return_mean) == (50, 5.0)
        assert one.state_dict()["networks"]["weight"].item() == 5.0


def test_random_actions_say_nothing_of_the_weights(tmp_path):
    recipe = DQN(
        env="CartPole-v1", backbone=mlp(hidden_dim=8), random_steps=1000, total_steps=1100,
        steps_per_batch=100, updates_per_step=0.01,
    )  # fmt: skip
    run = train(recipe, tmp_path / "dqn")
    with pytest.raises(ValueError, match="no best weights yet"):
        load_trained(run, best=True)


@pytest.fixture
def run(tmp_path):
    run = train(RECIPE, tmp_path / "run")
    return run


def test_the_best_weights_are_those_that_collected_the_best_episodes(run, capsys):
    _, state = load_checkpoint(run.checkpoints)
    step = state["best"]["step"]
    assert step in (256, 512, 768)
    if step > 256:  # the three newest checkpoints are kept
        assert_same(
            state["best"]["networks"], load_checkpoint(run.checkpoints, step)[1]["networks"]
        )
    loaded_step, algorithm, _ = load_trained(run, best=True)
    assert loaded_step == step
    assert_same(dict(algorithm.model.state_dict()), dict(state["best"]["networks"]))

    last, best = evaluate(run), evaluate(run, best=True)
    assert (last["weights"], last["steps"]) == ("last", 1024)
    assert (best["weights"], best["steps"]) == ("best", step)
    main(["evaluate", str(run.folder), "--best"])
    said = f"after {step} steps (best weights, on new episodes from seed {best['seed']})"
    assert said in capsys.readouterr().out
    assert json.loads((run.folder / "evaluation_best.json").read_text()) == best
    assert not (run.folder / "evaluation.json").exists()


def test_the_best_weights_are_packed_exported_and_drawn(run, tmp_path, capsys):
    step, algorithm, _ = load_trained(run, best=True)
    folder, out = str(run.folder), tmp_path / "agent"
    unevaluated = load_agent(folder, best=True)
    assert (unevaluated.steps, unevaluated.evaluation) == (step, {})
    for weights in ([], ["--best"]):
        with pytest.raises(SystemExit):
            main(["share", folder, "--out", str(out), *weights])
        assert f"run `evaluate {' '.join([folder, *weights])}` first" in capsys.readouterr().err
        main(["evaluate", folder, *weights])
    main(["share", folder, "--out", str(out), "--best"])
    packed = load_agent(out)
    for agent in (load_agent(folder, best=True), packed):
        assert_same(dict(agent.policy.state_dict()), dict(algorithm.policy.state_dict()))
        assert (agent.steps, agent.evaluation["weights"]) == (step, "best")
        assert agent.evaluate().tolist() == agent.evaluation["returns"]
    assert "had the highest return in training" in (out / "README.md").read_text()

    capsys.readouterr()
    main(["export", folder, "--out", str(tmp_path / "best.pt2"), "--best"])
    exported = torch.export.load(tmp_path / "best.pt2").module()
    observation = torch.rand(3, 4)
    outputs = exported(observation=observation)
    history = packed.make_env(3).reset().set("history", observation.unsqueeze(1))
    torch.testing.assert_close(outputs["logits"], packed.policy(history)["logits"])
    main(["explain", folder, "--out", str(tmp_path / "best.png"), "--best"])
    assert (tmp_path / "best.png").is_file()

    with pytest.raises(AgentError, match="is an agent, with one set of weights"):
        load_agent(out, best=True)


def test_best_weights_that_evaluations_chose_play_new_episodes(tmp_path):
    run = train(replace(RECIPE, evaluation_interval=512), tmp_path / "run")
    assert load_agent(run.folder).first_seed == RECIPE.evaluation_seed
    assert load_agent(run.folder, best=True).first_seed == RECIPE.evaluation_seed + 2


def test_a_run_without_best_weights_is_refused_in_one_line(tmp_path, capsys):
    run = train(replace(RECIPE, total_steps=256), tmp_path / "run")
    capsys.readouterr()
    for command, name in (("share", "agent"), ("export", "agent.pt2"), ("explain", "a.png")):
        with pytest.raises(SystemExit):
            main([command, str(run.folder), "--out", str(tmp_path / name), "--best"])
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "has no best weights yet" in said
        assert not (tmp_path / name).exists()
