"""Runs that are killed, interrupted, damaged or poisoned."""

import json
import shutil
import signal
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from recipes import runner
from recipes.algorithm import make_algorithm
from recipes.dataset_recipe import DatasetRecipe
from recipes.metrics import read_metrics
from recipes.ppo import PPO
from recipes.recipe_json import recipe_to_json
from recipes.registry import RECIPES
from recipes.results.plot import plot_run
from recipes.run import Run
from tests.recipes.commands import Command
from tests.recipes.states import TIMES, assert_same, unchecked
from torchrl_tit.checkpoint import CheckpointError, latest_step, load_checkpoint
from torchrl_tit.settings.networks import enhanced_tit

SMALL = PPO(
    name="ppo/cartpole/small",
    env="CartPole-v1",
    num_envs=2,
    # Active dropout draws from the global generator too.
    backbone=enhanced_tit(3, embed_dim=8, features_dim=8, ffn_dropout_inner=0.1),
    total_steps=64 * 14,
    steps_per_batch=64,
    minibatch_size=32,
    epochs=2,
    checkpoint_interval=64,
    evaluation_episodes=2,
)


def wait_for_step(process: Command, run: Path, step: int) -> None:
    """Waits until a run has saved a step, or ended."""
    while process.poll() is None and (latest_step(run / "checkpoints") or 0) < step:
        time.sleep(0.005)


def final(run: Path) -> tuple[int, dict]:
    return load_checkpoint(run / "checkpoints")


@pytest.mark.slow
def test_killed_and_resumed_loses_nothing_that_was_saved(tmp_path):
    """Nor does it depend on the moment of the kill, but for the steps since the checkpoint."""
    with Run.create(tmp_path / "whole", SMALL) as run:
        runner.train(SMALL, run)
    (tmp_path / "recipe.json").write_text(recipe_to_json(SMALL))
    killed = tmp_path / "killed"
    process = Command(["train", tmp_path / "recipe.json", "--out", killed], tmp_path / "errors")
    wait_for_step(process, killed, 4 * 64)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    step = latest_step(killed / "checkpoints")
    assert step
    shutil.copytree(killed, tmp_path / "copy")
    for folder in (killed, tmp_path / "copy"):
        process = Command(["train", "--resume", folder], tmp_path / "errors")
        assert process.wait() == 0, process.errors.read_text()
        said = f"note: resuming at step {step} with new episodes: environments are not saved"
        assert said in process.errors.read_text()
    assert_same(final(killed), final(tmp_path / "copy"))
    assert final(killed)[0] == SMALL.final_step
    rows, copied, expected = (
        [{k: str(v) for k, v in row.items() if k not in TIMES} for row in read_metrics(path)]
        for path in (tmp_path / name / "metrics.csv" for name in ("killed", "copy", "whole"))
    )
    assert rows == copied
    assert len(rows) == len(expected)
    assert rows[: step // 64] == expected[: step // 64]


def test_ctrl_c_saves_and_resume_goes_on(tmp_path):
    (tmp_path / "recipe.json").write_text(
        recipe_to_json(replace(SMALL, checkpoint_interval=10**6, total_steps=64 * 400))
    )
    run = tmp_path / "run"
    process = Command(["train", tmp_path / "recipe.json", "--out", run], tmp_path / "errors")
    while len(read_metrics(run / "metrics.csv")) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    assert f"train --resume {run}" in process.errors.read_text()
    step, _ = final(run)
    assert step == read_metrics(run / "metrics.csv")[-1]["step"]
    assert not (run / "evaluation.json").exists()


def test_rows_past_the_checkpoint_are_cut(tmp_path):
    recipe = replace(SMALL, total_steps=64 * 4, checkpoint_interval=10**6)
    with Run.create(tmp_path / "run", recipe) as run:
        runner.train(recipe, run)
        metrics = run.metrics(["return_mean"], last_step=10**6)
        metrics.close()
        path = run.folder / "metrics.csv"
        path.write_text(
            "step,time,steps_per_second,return_mean\n64,1.0,9,5.0\n128,2.0,9,6.0\n192,3.0,9,7.0\n256,4."
        )
        metrics = run.metrics(["return_mean"], last_step=128)
        metrics.log(192, return_mean=9.0)
        metrics.close()
    assert [row["return_mean"] for row in read_metrics(path)] == [5.0, 6.0, 9.0]
    events = EventAccumulator(str(run.folder / "tensorboard")).Reload()
    scalars = events.Scalars("return_mean")
    assert [(event.step, event.value) for event in scalars] == [(64, 5.0), (128, 6.0), (192, 9.0)]


def test_a_run_in_use_is_refused(tmp_path):
    other = Run.create(tmp_path / "run", SMALL)
    with other, pytest.raises(RuntimeError, match="in use by another process"):
        Run.open(tmp_path / "run").__enter__()


@pytest.mark.parametrize("damage", ["truncate", "flip", "pickle", "json"])
def test_a_damaged_or_foreign_checkpoint_runs_nothing(damage, tmp_path):
    recipe = replace(SMALL, total_steps=64)
    with Run.create(tmp_path / "run", recipe) as run:
        runner.train(recipe, run)
    (folder,) = run.checkpoints.iterdir()
    tensors = folder / "tensors.safetensors"
    content = tensors.read_bytes()
    if damage == "truncate":
        tensors.write_bytes(content[:-10])
    elif damage == "flip":
        tensors.write_bytes(content[:-10] + bytes([content[-10] ^ 1]) + content[-9:])
    elif damage == "pickle":
        (folder / "extra.pkl").write_bytes(b"cos\nsystem\n(S'touch owned'\ntR.")
    else:
        (folder / "state.json").write_text("{")
    before = sorted(p.name for p in run.folder.rglob("*"))
    with run, pytest.raises(CheckpointError, match=str(folder)):
        runner.train(recipe, run)
    assert sorted(p.name for p in run.folder.rglob("*")) == before


def test_not_finite_stops_with_step_term_and_checkpoint(tmp_path):
    recipe = replace(SMALL, total_steps=64 * 4)
    with Run.create(tmp_path / "run", recipe) as run:
        runner.train(replace(recipe, total_steps=64 * 2), run)
        poisoned = unchecked(recipe, critic_coeff=float("inf"))
        with pytest.raises(FloatingPointError, match=r"loss_critic .*step 192.*step 128 is good"):
            runner.train(poisoned, run)
    assert latest_step(run.checkpoints) == 128


def test_a_full_disk_leaves_the_old_checkpoints(tmp_path, monkeypatch):
    recipe = replace(SMALL, total_steps=64 * 4)
    with Run.create(tmp_path / "run", recipe) as run:
        runner.train(replace(recipe, total_steps=64 * 2), run)

        def full(*_args, **_kwargs):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", full)
        with pytest.raises(OSError, match="No space left"):
            runner.train(recipe, run)
    monkeypatch.undo()
    assert latest_step(run.checkpoints) == 128
    assert final(run.folder)[0] == 128


def test_another_recipe_than_the_checkpoint_is_refused(tmp_path):
    recipe = replace(SMALL, total_steps=64)
    with Run.create(tmp_path / "run", recipe) as run:
        runner.train(recipe, run)
        wider = replace(recipe, backbone=enhanced_tit(3, embed_dim=16))
        with pytest.raises(ValueError, match="does not fit"):
            runner.train(wider, run)


def test_run_folder_holds_what_it_says(tmp_path):
    recipe = replace(SMALL, total_steps=64 * 2)
    with Run.create(tmp_path / "run", recipe) as run:
        runner.train(recipe, run)
        run.save_evaluation(runner.evaluate(run))
        plot_run(run)
        assert run.is_complete()
    evaluation = json.loads((run.folder / "evaluation.json").read_text())
    assert len(evaluation["returns"]) == evaluation["episodes"] == 2
    assert evaluation["mean"] == pytest.approx(sum(evaluation["returns"]) / 2)
    assert (evaluation["env"], evaluation["steps"]) == ("CartPole-v1", 128)
    assert evaluation["seed"] == recipe.evaluation_seed
    assert (run.folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((run.folder / "versions.json").read_text())["torch"] == version("torch")
    assert Run.open(run.folder).recipe == recipe


@pytest.mark.slow
def test_every_named_recipe_builds_its_agent():
    built = set()
    for name, recipe in RECIPES.items():
        # Recipes of Atari games differ in the game alone (tests/recipes/ppo/test_atari.py); those
        # without velocities are built in tests/recipes/ppo/test_no_velocity.py.
        if recipe.env.startswith("ALE/") and "pong" not in name and "nature-cnn" not in name:
            continue
        if "-no-velocity/" in name:
            continue
        if isinstance(recipe, DatasetRecipe) and recipe.dataset in D4RL_DATASETS:  # not read here
            alike = replace(recipe, name="", dataset="hopper-medium-v2")
            if alike in built:
                continue
            built.add(alike)
        if name.startswith("discrete-cql/"):  # on data that its user collects
            with pytest.raises(FileNotFoundError, match=r"no data file data/.*create it first"):
                make_algorithm(recipe).check()
        else:
            make_algorithm(recipe).check()
