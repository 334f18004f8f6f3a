"""The weights with the highest return are kept, and evaluated on new episodes."""

import json

import pytest
from torch import nn

from recipes.cli import main
from recipes.core.progress import EPISODES, Best
from recipes.core.runner import evaluate, load_trained
from recipes.dqn import DQN
from recipes.ppo import PPO
from tests.recipes.small import train
from tests.recipes.states import assert_same
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
