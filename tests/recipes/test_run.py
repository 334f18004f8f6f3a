"""Run folders: made, continued, refused; and runs at the edges of what a recipe can say."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from recipes import runner
from recipes.cli import main
from recipes.metrics import Metrics, read_metrics
from recipes.ppo import PPO
from recipes.recipe_json import settings_to_dict
from recipes.results.plot import plot_run
from recipes.run import Run
from tests.recipes.commands import Command
from tests.recipes.states import unchecked
from tests.recipes.untrained import untrained
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint
from torchrl_tit.settings.networks import enhanced_tit

ROOT = Path(__file__).parents[2]
SMALL = PPO(
    name="ppo/cartpole/small",
    env="CartPole-v1",
    backbone=enhanced_tit(embed_dim=8, features_dim=8),
    total_steps=128,
    steps_per_batch=64,
    num_envs=2,
    minibatch_size=32,
    epochs=1,
    checkpoint_interval=64,
    evaluation_episodes=2,
)


BACKBONE = settings_to_dict(SMALL.backbone)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def trained(folder: Path, recipe: PPO = SMALL) -> Run:
    with Run.create(folder, recipe) as run:
        runner.train(recipe, run)
    return run


def test_what_a_kill_leaves_before_the_recipe_is_no_run(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("versions.json", ".lock", ".recipe.json.0a1b2c3d.tmp"):
        (folder / name).touch()
    assert Run.create(folder, SMALL).recipe == Run.open(folder).recipe == SMALL


def test_what_killed_writes_left_is_removed(tmp_path):
    run = untrained(tmp_path / "run", SMALL)
    for name in (".metrics.csv.0a1b2c3d.tmp", ".recipe.json.0a1b2c3d.tmp", ".mine.0a1b2c3d.tmp"):
        (run.folder / name).touch()
    with run:
        hidden = {path.name for path in run.folder.iterdir() if path.name.startswith(".")}
    assert hidden == {".lock", ".mine.0a1b2c3d.tmp"}


def test_a_folder_may_be_named_by_text(tmp_path):
    Run.create(str(tmp_path / "run"), SMALL)
    assert Run.open(str(tmp_path / "run")).checkpoints == tmp_path / "run" / "checkpoints"


def edit(path: Path, **fields: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def fails(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as exit_:
        main(list(map(str, words)))
    assert exit_.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_a_folder_that_a_killed_process_had_only_begun_becomes_a_run(tmp_path, monkeypatch):
    def killed(path, text):
        if path.name == "recipe.json":
            raise SystemExit
        path.write_text(text)

    with monkeypatch.context() as patch:
        patch.setattr("recipes.run.write_text_atomic", killed)
        with pytest.raises(SystemExit):
            Run.create(tmp_path / "run", SMALL)
    assert Run.create(tmp_path / "run", SMALL).recipe == SMALL
    assert Run.open(tmp_path / "run").recipe == SMALL


def test_only_a_new_or_empty_folder_becomes_a_run(tmp_path):
    (tmp_path / "empty").mkdir()
    assert Run.create(tmp_path / "empty", SMALL).folder == tmp_path / "empty"
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    (tmp_path / "file").write_text("a file")
    for name in ("full", "file", "empty"):
        with pytest.raises(FileExistsError, match=r"exists already.*--resume.*--out"):
            Run.create(tmp_path / name, SMALL)
    assert contents(tmp_path / "full") == {"thesis.tex": b"years of work"}


def test_runs_of_the_same_second_get_folders_of_their_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda _: "20260101-000000")
    monkeypatch.setattr(runner, "train", lambda *_: None)
    monkeypatch.setattr("recipes.cli.training.plot_run", lambda run: None)
    evaluation = {"mean": 0, "std": 0, "episodes": 1, "steps": 0, "weights": "last"}
    monkeypatch.setattr(runner, "evaluate", lambda *_, **__: evaluation)
    for _ in range(3):
        main(["train", "ppo/cartpole/enhanced-tit"])
    folders = sorted(path.name for path in Path("runs/ppo/cartpole/enhanced-tit").iterdir())
    name = "seed-0-20260101-000000"
    assert folders == [name, f"{name}-2", f"{name}-3"]


def test_is_complete_only_when_trained_evaluated_and_drawn(tmp_path):
    run = trained(tmp_path / "run")
    assert not run.is_complete()
    evaluation = {
        "env": "CartPole-v1",
        "episodes": 1,
        "seed": 1,
        "returns": [9],
        "mean": 9,
        "std": 0,
    }
    run.save_evaluation(evaluation | {"steps": 64})  # of a checkpoint on the way
    plot_run(run)
    assert not run.is_complete()
    run.save_evaluation(evaluation | {"steps": 128})
    assert run.is_complete()
    (run.folder / "evaluation.json").write_text("{")
    assert not run.is_complete()
    (run.folder / "evaluation.json").write_text("[]")
    assert not run.is_complete()
    run.save_evaluation(evaluation | {"steps": 128})
    (run.folder / "learning_curve.png").unlink()
    assert not run.is_complete()


def test_a_run_that_was_stopped_in_its_evaluation_is_evaluated_then(tmp_path, monkeypatch, capsys):
    def ctrl_c(*_, **__):
        raise KeyboardInterrupt

    arguments = ["train", "ppo/cartpole/enhanced-tit", "--out", str(tmp_path / "run")]
    arguments += ["--total-steps", "64", "--steps-per-batch", "64", "--epochs", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(runner, "evaluate", ctrl_c)
        with pytest.raises(SystemExit) as exit_:
            main([*arguments, "--evaluation-episodes", "2"])
    assert exit_.value.code == 130
    assert f"train --resume {tmp_path / 'run'}" in capsys.readouterr().err
    metrics = (tmp_path / "run" / "metrics.csv").read_text()
    main(["train", "--resume", str(tmp_path / "run")])
    assert (tmp_path / "run" / "metrics.csv").read_text() == metrics
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["steps"] == 64
    assert (tmp_path / "run" / "learning_curve.png").is_file()


def test_ctrl_c_saves_and_the_run_can_be_resumed(tmp_path, monkeypatch):
    recipe = replace(SMALL, total_steps=256, checkpoint_interval=10**6)
    log = Metrics.log

    def ctrl_c(metrics, step, **values):
        log(metrics, step, **values)
        if step == 128:
            os.kill(os.getpid(), signal.SIGINT)

    with Run.create(tmp_path / "run", recipe) as run:
        with monkeypatch.context() as patch:
            patch.setattr(Metrics, "log", ctrl_c)
            with pytest.raises(KeyboardInterrupt):
                runner.train(recipe, run)
        assert checkpoint_steps(run.checkpoints) == [128]
        runner.train(recipe, run)
    assert checkpoint_steps(run.checkpoints) == [128, 256]


def test_a_second_ctrl_c_stops_at_once(tmp_path, monkeypatch):
    def twice(*_):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("recipes.ppo.PPOAlgorithm.advantages", twice)
    with Run.create(tmp_path / "run", SMALL) as run, pytest.raises(KeyboardInterrupt):
        runner.train(SMALL, run)
    assert checkpoint_steps(run.checkpoints) == []
    assert read_metrics(run.folder / "metrics.csv") == []
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_that_ctrl_c_brings_about_is_a_stop(tmp_path, monkeypatch):
    def compiler_stopped(*_):
        os.kill(os.getpid(), signal.SIGINT)
        raise RuntimeError("C++ compile error")

    monkeypatch.setattr("recipes.ppo.PPOAlgorithm.advantages", compiler_stopped)
    with Run.create(tmp_path / "run", SMALL) as run, pytest.raises(KeyboardInterrupt):
        runner.train(SMALL, run)


def test_version_changes(tmp_path):
    run = Run.create(tmp_path / "run", SMALL)
    assert run.version_changes() == []
    edit(run.folder / "versions.json", torch="1.0")
    assert run.version_changes() == [f"torch 1.0 -> {version('torch')}"]
    for text in ("{", "[]", "[" * 100_000):
        (run.folder / "versions.json").write_text(text)
        assert run.version_changes() == []


def test_a_damaged_list_of_imports_does_not_hide_the_reason(tmp_path):
    run = Run.create(tmp_path / "run", SMALL)
    edit(run.folder / "recipe.json", env="evilmod:Mine-v0")
    (run.folder / "imports.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="names 'evilmod:Mine-v0'"):
        Run.open(run.folder)


def test_an_edited_recipe_takes_effect(tmp_path):
    run = trained(tmp_path / "run")
    edit(run.folder / "recipe.json", total_steps=192, learning_rate=0.01)
    with Run.open(run.folder) as again:
        runner.train(again.recipe, again)
    rows = read_metrics(run.folder / "metrics.csv")
    assert [row["learning_rate"] for row in rows] == [3e-4, 3e-4, 0.01]
    _, state = load_checkpoint(run.checkpoints)
    assert state["optimizer"]["param_groups"][0]["lr"] == 0.01


@pytest.mark.parametrize(
    "fields",
    [
        {"env": "Acrobot-v1"},
        {"backbone": {**BACKBONE, "frame": {"encoder": "inner", "embed_dim": 16}}},
        {"backbone": {**BACKBONE, "frame": {"encoder": "linear", "embed_dim": 8}}},
        {"backbone": {**BACKBONE, "trunks": "separate"}},
        {"backbone": {**BACKBONE, "num_frames": 2}},  # whose weights would fit
    ],
    ids=str,
)
def test_an_edited_recipe_that_no_longer_fits_changes_nothing(fields, tmp_path, capsys):
    run = trained(tmp_path / "run")
    edit(run.folder / "recipe.json", total_steps=192, **fields)
    before = contents(run.folder)
    line = fails(capsys, "train", "--resume", run.folder)
    assert "the checkpoint of step 128" in line
    assert "does not fit" in line
    assert "recipe.json" in line
    assert contents(run.folder) == before


@pytest.mark.parametrize("text", [b"\xff\xfe{", b"[" * 100_000, b"{}", b"null"])
def test_a_damaged_recipe_is_named(text, tmp_path, capsys):
    run = trained(tmp_path / "run")
    (run.folder / "recipe.json").write_bytes(text)
    before = contents(run.folder)
    for words in (["train", "--resume"], ["evaluate"]):
        assert "recipe.json cannot be read as a recipe" in fails(capsys, *words, run.folder)
    assert contents(run.folder) == before


def test_a_run_of_an_older_version_is_named(tmp_path, capsys):
    run = trained(tmp_path / "run")
    _, state = load_checkpoint(run.checkpoints)
    state["agent"] = state.pop("networks")
    run.save(192, state)
    edit(run.folder / "recipe.json", total_steps=256)
    for words in (["train", "--resume"], ["evaluate"]):
        line = fails(capsys, *words, run.folder)
        assert "the checkpoint of step 192" in line
        assert "is from an older version of torchrl-tit" in line
    edit(run.folder / "recipe.json", backbone={"network": "enhanced-tit", "embed_dim": 8})
    assert "'backbone.network' is from an older version" in fails(capsys, "evaluate", run.folder)


def test_batches_that_no_longer_meet_the_last_step_are_saved_all_the_same(tmp_path):
    run = trained(tmp_path / "run")
    recipe = replace(SMALL, total_steps=192, steps_per_batch=96, checkpoint_interval=10**6)
    with run:
        runner.train(recipe, run)
    assert run.load()[0] == 224  # type: ignore[index]


def test_no_episode_ends_at_all(tmp_path):
    run = trained(tmp_path / "run", replace(SMALL, env="Pendulum-v1"))
    rows = read_metrics(run.folder / "metrics.csv")
    assert [row["episodes"] for row in rows] == [0, 0]
    assert np.isnan([row["return_mean"] for row in rows]).all()
    plot_run(run)
    assert run.curve.read_bytes().startswith(b"\x89PNG")


def test_fewer_steps_than_a_batch_are_one_batch(tmp_path):
    run = trained(tmp_path / "run", replace(SMALL, total_steps=1))
    assert run.load()[0] == 64  # type: ignore[index]


@pytest.mark.parametrize("minibatch_size", [32, 64], ids=["in the update", "after it"])
def test_weights_that_explode_are_never_saved(minibatch_size, tmp_path):
    recipe = replace(SMALL, total_steps=192, minibatch_size=minibatch_size)
    run = trained(tmp_path / "run", replace(recipe, total_steps=64))
    message = r"weights became (inf|nan) in the update at step 128; the checkpoint of step 64 is"
    with run, pytest.raises(FloatingPointError, match=message):
        runner.train(unchecked(recipe, learning_rate=1e30), run)
    assert run.load()[0] == 64  # type: ignore[index]
    assert len(read_metrics(run.folder / "metrics.csv")) == 1


def test_unicode_and_relative_paths(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--total-steps", "64", "--steps-per-batch", "64", "--evaluation-episodes", "1"]
    main(["train", "ppo/cartpole/enhanced-tit", "--out", "läufe/一 号", "--epochs", "1", *words])
    assert "run folder: läufe/一 号" in capsys.readouterr().out
    monkeypatch.chdir("läufe")
    main(["evaluate", "一 号", "--out", "wertung.json"])
    assert json.loads(Path("wertung.json").read_text())["episodes"] == 1


def test_a_disk_that_is_full_stops_the_process_with_one_line(tmp_path):
    """The limit on a file's size stands for the disk; the metrics still fit, a checkpoint not."""
    run = trained(tmp_path / "run")
    edit(run.folder / "recipe.json", total_steps=256)
    before = contents(run.checkpoints)
    process = Command(["train", "--resume", run.folder], tmp_path / "errors", file_size=20_000)
    assert process.wait() == 2
    errors = process.errors.read_text()
    line = errors.splitlines()[-1]
    assert line.startswith("error: the checkpoint of step 192 could not be saved")
    assert "Traceback" not in errors
    assert contents(run.checkpoints) == before


def test_a_run_of_any_algorithm_is_opened_by_a_script_of_its_own():
    script = (
        "from recipes.records import Records; from recipes.run import RecordedRun; "
        "print(RecordedRun(Records('docs/results/cartpole'), 'mlp/seed-0').recipe.env)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout == "CartPole-v1\n", done.stderr
