"""Tasks without their velocities: the networks compared on them."""

from dataclasses import replace

from gymnasium.vector import AsyncVectorEnv

from recipes.core.run import Run
from recipes.core.runner import evaluate, train
from tests.recipes.ppo.algorithms import named
from torchrl_tit.checkpoint import load_checkpoint


def test_a_run_in_processes_is_the_run_in_one(tmp_path, monkeypatch):
    recipe = replace(
        named("ppo/cartpole-no-velocity/mlp-stack-8"),
        num_envs=2,
        steps_per_batch=32,
        total_steps=64,
        minibatch_size=16,
        epochs=1,
        evaluation_episodes=3,
    )
    results, made = [], []

    class Processes(AsyncVectorEnv):
        def __init__(self, *arguments, **options):
            made.append(recipe.vectorization_mode)
            super().__init__(*arguments, **options)

    monkeypatch.setattr("torchrl_tit.envs.gymnasium_tasks.AsyncVectorEnv", Processes)
    for mode in ("sync", "async"):
        recipe = replace(recipe, vectorization_mode=mode)
        with Run.create(tmp_path / mode, recipe) as run:
            train(recipe, run)
            evaluation = evaluate(run)
        results.append((load_checkpoint(run.checkpoints)[1]["networks"], evaluation["returns"]))
    assert made == ["async"]
    (sync, returns), (async_, async_returns) = results
    assert returns == async_returns
    for name, weight in sync.items():
        assert (weight == async_[name]).all()
