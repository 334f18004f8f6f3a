"""Sweeps: complete runs stay, killed ones go on, other settings are refused."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest

from recipes.cli import main, training
from recipes.core import runner
from recipes.core.recipe_json import recipe_to_json
from recipes.core.registry import RECIPES
from recipes.core.run import Run
from recipes.tools.results.plot import plot_run
from recipes.tools.sweeps import sweep
from tests.recipes.commands import Command, fails
from tests.recipes.small import BC, TINY, make, make_dt
from tests.recipes.sweeps.sweep_runs import begin, fork_worker


def long_run(folder):
    """A recipe in a file, and its run in a sweep, which is only over when it is stopped."""
    path = folder / "recipe.json"
    long = replace(TINY, total_steps=10**6, checkpoint_interval=10**6, compile="off")
    path.write_text(recipe_to_json(long))
    [job] = sweep.make_jobs([str(path)], [0], folder / "sweep")
    return path, job


def is_training(job):
    metrics = job.folder / "metrics.csv"
    return metrics.exists() and len(metrics.read_text().splitlines()) > 1


def test_patterns_and_seeds_make_the_runs(tmp_path):
    jobs = sweep.make_jobs(["ppo/*/mlp", "ppo/cartpole/mlp"], [3, 3, 4], tmp_path)
    names = [name for name in RECIPES if name.count("/") == 2]
    fitting = [name for name in names if name.startswith("ppo/") and name.endswith("/mlp")]
    assert len(jobs) == 2 * len(fitting)
    assert {job.recipe.seed for job in jobs} == {3, 4}
    assert all(job.folder == tmp_path / job.recipe.name / f"seed-{job.recipe.seed}" for job in jobs)


def test_files_of_recipes_are_swept_beside_named_ones(tmp_path):
    mine = replace(TINY, name="ppo/cartpole/mine", seed=7)
    file = tmp_path / "mine.json"
    file.write_text(recipe_to_json(mine))
    jobs = sweep.make_jobs([str(file), "ppo/cartpole/mlp", str(file)], [0, 1], tmp_path)
    assert [job.recipe for job in jobs[:2]] == [replace(mine, seed=0), replace(mine, seed=1)]
    assert [job.recipe.name for job in jobs[2:]] == ["ppo/cartpole/mlp"] * 2
    assert jobs[0].folder == tmp_path / "ppo/cartpole/mine/seed-0"
    assert jobs[1].arguments()[:4] == ["train", str(file), "--seed", "1"]
    assert jobs[2].arguments()[:2] == ["train", "ppo/cartpole/mlp"]


@pytest.mark.parametrize("order", [1, -1])
def test_a_file_with_the_name_of_another_recipe_is_refused(order, tmp_path):
    file = tmp_path / "mine.json"
    file.write_text(recipe_to_json(replace(TINY, name="ppo/cartpole/mlp")))
    with pytest.raises(ValueError, match="both called 'ppo/cartpole/mlp' and differ"):
        sweep.make_jobs([str(file), "ppo/cartpole/*"][::order], [0], tmp_path)
    file.write_text(recipe_to_json(replace(TINY, name="")))
    with pytest.raises(ValueError, match=r"mine\.json has no name"):
        sweep.make_jobs([str(file)], [0], tmp_path)
    with pytest.raises(FileNotFoundError, match=r"yours\.json"):
        sweep.make_jobs([str(tmp_path / "yours.json")], [0], tmp_path)


def test_a_run_whose_frame_encoders_were_chosen_by_kind_is_the_sweeps(tmp_path, monkeypatch):
    """The run names them, the recipe that is swept does not."""
    pytest.importorskip("minigrid")
    file = tmp_path / "grid.json"
    recipe = replace(TINY, name="ppo/grid/mlp", env="MiniGrid-Empty-5x5-v0")
    file.write_text(recipe_to_json(recipe))
    [job] = sweep.make_jobs([str(file)], [0], tmp_path)
    monkeypatch.setattr(training, "_finish", lambda *_: None)
    main(job.arguments())
    assert Run.open(job.folder).recipe.backbone.frames
    assert sweep.make_jobs([str(file)], [0], tmp_path) == [job]


@pytest.mark.parametrize("recipe_of", [partial(make, BC), partial(make_dt, target_returns=())])
def test_a_run_whose_data_say_what_the_recipe_does_not_is_the_sweeps(
    recipe_of, tmp_path, monkeypatch
):
    file = tmp_path / "recipe.json"
    recipe = replace(recipe_of(tmp_path, env=""), name="mine/logs")
    file.write_text(recipe_to_json(recipe))
    [job] = sweep.make_jobs([str(file)], [0], tmp_path)
    monkeypatch.setattr(training, "_finish", lambda *_: None)
    main(job.arguments())
    assert Run.open(job.folder).recipe.env_settings
    assert sweep.make_jobs([str(file)], [0], tmp_path) == [job]


@pytest.mark.slow
def test_sweep_resumes_runs_and_leaves_complete_ones(tmp_path, capsys):
    jobs = [
        sweep.Job(replace(TINY, seed=seed), tmp_path / TINY.name / f"seed-{seed}")
        for seed in range(3)
    ]
    for job in jobs:
        begin(job.folder, job.recipe)
    with Run.open(jobs[0].folder) as run:  # complete already
        runner.train(run.recipe, run)
        run.save_evaluation(runner.evaluate(run))
        plot_run(run)
    before = (jobs[0].folder / "evaluation.json").stat().st_mtime_ns
    assert [job.is_complete() for job in jobs] == [True, False, False]
    assert sweep.run_jobs(jobs, workers=2, start=fork_worker) == []
    assert all(job.is_complete() for job in jobs)
    assert (jobs[0].folder / "evaluation.json").stat().st_mtime_ns == before
    assert not jobs[0].log.exists()


@pytest.mark.slow
def test_failures_are_named(tmp_path):
    job = sweep.Job(TINY, tmp_path / "seed-0")
    begin(job.folder, TINY)
    (job.folder / "checkpoints" / "000000000064").mkdir(parents=True)  # no checkpoint of ours
    assert sweep.run_jobs([job], workers=1) == [job]
    assert "error: " in job.log.read_text()


def test_a_run_in_use_is_waited_for(tmp_path):
    free, used = (sweep.Job(replace(TINY, seed=seed), tmp_path / f"{seed}") for seed in range(2))
    for job in (free, used):
        begin(job.folder, job.recipe)
    lock = Run.open(used.folder)
    lock.__enter__()
    begun = []

    def start(job):
        begun.append((job, job.is_in_use()))
        lock.__exit__()  # the other process ends once the free run has begun
        return subprocess.Popen([sys.executable, "-c", ""])

    assert sweep.run_jobs([used, free], workers=2, start=start) == []
    assert begun == [(free, False), (used, False)]


def test_a_file_that_is_changed_in_between_is_a_failure(tmp_path):
    """Later seeds would have other settings than the first, and nobody would know."""
    job = sweep.Job(replace(TINY, seed=1), tmp_path / "seed-1")

    def start(job):
        begin(job.folder, replace(job.recipe, epochs=job.recipe.epochs + 1))
        return subprocess.Popen([sys.executable, "-c", ""])

    assert sweep.run_jobs([job], workers=1, start=start) == [job]
    assert "seed-1 holds a run of " in job.log.read_text()


@pytest.mark.parametrize("completes", [True, False])
def test_a_run_that_another_sweep_began_first_is_no_failure(completes, tmp_path, monkeypatch):
    job = begin(tmp_path / "run", TINY)
    other = Run.open(job.folder)
    codes = [2, 0]  # the first worker finds the run in use

    def start(job):
        if len(codes) == 2:
            other.__enter__()
        return subprocess.Popen([sys.executable, "-c", f"raise SystemExit({codes.pop(0)})"])

    def count_begun(running):
        if len(codes) == 1 and not running:
            other.__exit__()
        return len(running)

    if completes:  # before this sweep sees its own worker end
        monkeypatch.setattr(sweep.Job, "is_in_use", lambda job: False)
        monkeypatch.setattr(sweep.Job, "is_complete", lambda job: len(codes) == 1)
    assert sweep.run_jobs([job], workers=1, start=start, count_begun=count_begun) == []
    assert len(codes) == completes


def test_other_settings_under_the_same_name_are_refused(tmp_path, capsys):
    job = sweep.make_jobs(["ppo/cartpole/mlp"], [0], tmp_path)[0]
    begin(job.folder, TINY)
    assert "with other settings" in fails(
        capsys, "sweep", "ppo/acrobot/mlp", "ppo/cartpole/mlp", "--out", str(tmp_path)
    )
    assert not (tmp_path / "ppo/acrobot").exists()


@pytest.mark.slow
def test_ctrl_c_stops_every_worker(tmp_path):
    path, job = long_run(tmp_path)
    process = Command(["sweep", path, "--out", tmp_path / "sweep"], tmp_path / "errors")
    while not is_training(job):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    assert "the same command resumes it" in process.errors.read_text()
    assert list((job.folder / "checkpoints").iterdir())
    with Run.open(job.folder):  # nobody is at work there any more
        pass


def test_sigterm_stops_every_worker(tmp_path, monkeypatch):
    _, job = long_run(tmp_path)

    def nap(seconds):
        time.sleep(0.05)
        if is_training(job):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(sweep, "time", SimpleNamespace(sleep=nap))
    with pytest.raises(KeyboardInterrupt):
        sweep.run_jobs([job], workers=1, start=fork_worker)
    assert list((job.folder / "checkpoints").iterdir())
    with Run.open(job.folder):  # nobody is at work there any more
        pass
