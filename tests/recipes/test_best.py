"""Best weights, and evaluations during training."""

import json
from dataclasses import replace

import pytest
import torch
from torch import nn

from recipes.best import EPISODES, Best
from recipes.cli import main
from recipes.metrics import read_metrics
from recipes.ppo import PPO
from recipes.run import Run
from recipes.runner import evaluate, load_trained, train
from recipes.sac import SAC
from tests.recipes.states import assert_same
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.settings.networks import enhanced_tit

SMALL = enhanced_tit(3, embed_dim=8, features_dim=8)
ONLINE = PPO(
    env="CartPole-v1",
    backbone=SMALL,
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
REPLAY = SAC(
    env="Pendulum-v1",
    backbone=SMALL,
    total_steps=80,
    random_steps=40,
    steps_per_batch=8,
    batch_size=8,
    num_envs=2,
    log_interval=20,
    checkpoint_interval=40,
    evaluation_episodes=1,
)


def run_of(recipe, folder):
    with Run.create(folder, recipe) as run:
        train(recipe, run)
    return run


def test_the_weights_with_the_highest_return_are_kept():
    layer = nn.Linear(1, 1, bias=False)
    best = Best(layer)

    def see(step, value, returns):
        nn.init.constant_(layer.weight, value)
        best.add_episodes(step, returns)

    see(10, 1.0, [5.0] * (EPISODES - 1))
    assert not best.state_dict()["networks"]  # too few episodes
    see(20, 2.0, [5.0])
    assert (best.step, best.return_mean) == (20, 5.0)
    see(30, 3.0, [4.0])
    see(40, 4.0, [])
    assert (best.step, best.return_mean) == (20, 5.0)
    state = best.state_dict()
    assert state["networks"]["weight"].item() == 2.0

    restored = Best(layer)
    restored.load_state_dict(state)
    for one in (best, restored):
        nn.init.constant_(layer.weight, 5.0)
        one.add_episodes(50, [6.0])  # 18 fives, a four and a six: as high as before
        assert (one.step, one.return_mean) == (50, 5.0)
        assert one.state_dict()["networks"]["weight"].item() == 5.0


def test_the_best_weights_are_evaluated(tmp_path, capsys):
    """They are those of the checkpoint after which the best episodes were collected."""
    run = run_of(ONLINE, tmp_path / "run")
    _, state = load_checkpoint(run.checkpoints)
    step = state["best"]["step"]
    assert step in (256, 512, 768)
    _, then = load_checkpoint(run.checkpoints, step) if step > 256 else (0, None)
    if then is not None:  # the three newest checkpoints are kept
        assert_same(state["best"]["networks"], then["networks"])
    loaded_step, algorithm, _ = load_trained(run, best=True)
    assert loaded_step == step
    assert_same(dict(algorithm.model.state_dict()), dict(state["best"]["networks"]))

    last, best = evaluate(run), evaluate(run, best=True)
    assert (last["weights"], last["steps"]) == ("last", 1024)
    assert (best["weights"], best["steps"]) == ("best", step)
    main(["evaluate", str(run.folder), "--best"])
    said = f"after {step} steps (best weights, on new episodes from seed {best['seed']})"
    assert said in capsys.readouterr().out
    written = json.loads((run.folder / "evaluation_best.json").read_text())
    assert written == best
    assert not (run.folder / "evaluation.json").exists()


def test_a_run_without_enough_episodes_has_no_best_weights(tmp_path):
    recipe = replace(ONLINE, total_steps=64, steps_per_batch=64)
    run = run_of(recipe, tmp_path / "run")
    with pytest.raises(ValueError, match="no best weights yet: fewer than 20 training episodes"):
        evaluate(run, best=True)


@pytest.mark.parametrize("recipe", [ONLINE, REPLAY], ids=["ppo", "sac"])
def test_evaluations_during_training_do_not_change_it(tmp_path, recipe):
    plain = run_of(recipe, tmp_path / "plain")
    interval = recipe.total_steps // 2
    evaluated = run_of(replace(recipe, evaluation_interval=interval), tmp_path / "evaluated")
    states = [load_checkpoint(run.checkpoints)[1] for run in (plain, evaluated)]
    assert_same(states[0]["networks"], states[1]["networks"])
    rows = read_metrics(evaluated.folder / "metrics.csv")
    measured = {int(row["step"]): row["evaluation_return"] for row in rows}
    steps = [step for step, value in measured.items() if value == value]
    assert steps == [interval, recipe.total_steps]
    outcomes = states[1]["record"]["outcomes"]
    means = [torch.tensor(outcome["returns"]).mean().item() for outcome in outcomes]
    assert [measured[step] for step in steps] == pytest.approx(means)
    assert evaluate(evaluated)["returns"] == outcomes[-1]["returns"]
    # Where there are evaluations, they choose the best weights, not the training episodes.
    best = states[1]["best"]
    assert best["return_mean"] == pytest.approx(max(means))
    highest = max(measured[step] for step in steps)
    assert best["step"] in [step for step in steps if measured[step] == highest]
    assert evaluate(evaluated, best=True)["seed"] == 1_000_000 + recipe.evaluation_episodes
