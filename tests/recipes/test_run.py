"""Run folders: made, continued, killed, damaged, used by two, and refused."""

from __future__ import annotations

import json
import shutil
import signal
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest

from recipes.cli import main
from recipes.core import run as run_module
from recipes.core import runner
from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.core.progress import Record
from recipes.core.recipe_json import recipe_to_json, settings_to_dict
from recipes.core.run import Run
from recipes.ppo import PPOAlgorithm
from recipes.tools.results.plot import plot_run
from tests.recipes.commands import Command, fails
from tests.recipes.small import TINY, assert_same_run, train
from tests.recipes.states import unchecked
from tests.recipes.untrained import untrained
from torchrl_tit.checkpoint import latest_step
from torchrl_tit.settings.networks import enhanced_tit

SMALL = replace(
    TINY, name="ppo/cartpole/small", backbone=enhanced_tit(embed_dim=8, features_dim=8), num_envs=2
)
LONG = replace(SMALL, total_steps=64 * 400)
BACKBONE = settings_to_dict(SMALL.backbone)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(SMALL, tmp_path_factory.mktemp("runs") / "run").folder


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Run:
    """A copy of a finished run."""
    return Run.open(shutil.copytree(finished, tmp_path / "run"))


def edit(path: Path, **fields: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def test_a_folder_that_a_killed_process_had_only_begun_becomes_a_run(tmp_path, monkeypatch):
    def killed(path, text):
        if path.name == "recipe.json":
            raise SystemExit
        path.write_text(text)

    with monkeypatch.context() as patch:
        patch.setattr("recipes.core.run.write_text_atomic", killed)
        with pytest.raises(SystemExit):
            Run.create(tmp_path / "run", SMALL)
    (tmp_path / "run" / ".recipe.json.0a1b2c3d.tmp").touch()
    assert Run.create(tmp_path / "run", SMALL).recipe == Run.open(tmp_path / "run").recipe == SMALL


def test_what_killed_writes_left_is_removed(tmp_path):
    run = untrained(tmp_path / "run", SMALL)
    for name in (".metrics.csv.0a1b2c3d.tmp", ".recipe.json.0a1b2c3d.tmp", ".mine.0a1b2c3d.tmp"):
        (run.folder / name).touch()
    with run:
        hidden = {path.name for path in run.folder.iterdir() if path.name.startswith(".")}
    assert hidden == {".lock", ".mine.0a1b2c3d.tmp"}


def test_only_a_new_or_empty_folder_becomes_a_run(tmp_path):
    (tmp_path / "empty").mkdir()
    assert Run.create(str(tmp_path / "empty"), SMALL).folder == tmp_path / "empty"
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
    evaluation = {"mean": 0, "std": 0, "episodes": 1, "steps": 0, "returns": [0]}
    evaluation["weights"] = "last"
    monkeypatch.setattr(runner, "evaluate", lambda *_, **__: evaluation)
    for _ in range(3):
        main(["train", "ppo/cartpole/enhanced-tit"])
    folders = sorted(path.name for path in Path("runs/ppo/cartpole/enhanced-tit").iterdir())
    name = "seed-0-20260101-000000"
    assert folders == [name, f"{name}-2", f"{name}-3"]


def test_a_run_is_complete_when_trained_evaluated_and_drawn(run):
    assert Run.open(run.folder).recipe == SMALL
    versions = json.loads((run.folder / "versions.json").read_text())
    assert versions["torch"] == version("torch")
    evaluation = runner.evaluate(run)
    assert [evaluation[x] for x in ("env", "steps", "episodes")] == ["CartPole-v1", 128, 2]
    assert evaluation["mean"] == pytest.approx(sum(evaluation["returns"]) / 2)
    assert not run.is_complete()
    run.save_evaluation(evaluation)
    assert not run.is_complete()
    plot_run(run)
    assert run.curve.read_bytes().startswith(b"\x89PNG")
    assert run.is_complete()
    newest = max(run.checkpoints.iterdir())
    newest.rename(run.folder / "elsewhere")  # resumed from the one before
    assert not run.is_complete()
    (run.folder / "elsewhere").rename(newest)
    assert run.is_complete()
    for text in ("{", "[]", json.dumps(evaluation | {"steps": 64})):  # of a checkpoint on the way
        (run.folder / "evaluation.json").write_text(text)
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


def test_version_changes(tmp_path):
    run = Run.create(tmp_path / "run", SMALL)
    assert run.version_changes() == []
    edit(run.folder / "versions.json", torch="1.0")
    assert run.version_changes() == [f"torch 1.0 -> {version('torch')}"]
    for text in ("{", "[]", "[" * 100_000):
        (run.folder / "versions.json").write_text(text)
        assert run.version_changes() == []


def test_a_resumed_run_keeps_all_versions_it_ran_with(tmp_path, capsys):
    run = Run.create(tmp_path / "run", SMALL)
    edit(run.folder / "versions.json", torch="1.0", removed="1")
    main(["train", "--resume", str(run.folder)])
    changed = f"1.0 -> {version('torch')}"
    assert f"versions changed since the start: torch {changed}\n" in capsys.readouterr().err
    assert run.versions()["torch"] == changed
    assert run.versions()["removed"] == "1"
    before = run.read("versions.json")
    main(["train", "--resume", str(run.folder), "--total-steps", "128"])
    assert "versions changed" not in capsys.readouterr().err
    assert run.read("versions.json") == before


def test_a_refused_resume_changes_nothing(tmp_path, capsys, monkeypatch):
    run = Run.create(tmp_path / "run", SMALL)
    main(["train", "--resume", str(run.folder)])
    before = contents(run.folder)
    longer = ["train", "--resume", run.folder, "--total-steps", "640"]
    assert "threads" in fails(capsys, *longer, "--threads", "99999")

    def check(algorithm):
        raise ValueError("the data are gone")

    with monkeypatch.context() as patch:
        patch.setattr(PPOAlgorithm, "check", check)
        assert "the data are gone" in fails(capsys, *longer)
    assert contents(run.folder) == before
    main([str(word) for word in longer])
    assert Run.open(run.folder).recipe.final_step == 640


def test_a_damaged_list_of_imports_does_not_hide_the_reason(tmp_path):
    run = Run.create(tmp_path / "run", SMALL)
    edit(run.folder / "recipe.json", env="evilmod:Mine-v0")
    (run.folder / "imports.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="names 'evilmod:Mine-v0'"):
        Run.open(run.folder)


@pytest.mark.parametrize(
    "fields",
    [
        {"env": "Acrobot-v1"},
        {"backbone": {**BACKBONE, "frame": {"encoder": "inner", "embed_dim": 16}}},
        {"backbone": {**BACKBONE, "trunks": "separate"}},
        {"backbone": {**BACKBONE, "num_frames": 2}},  # whose weights would fit
    ],
    ids=str,
)
def test_an_edited_recipe_that_no_longer_fits_changes_nothing(fields, run, capsys):
    edit(run.folder / "recipe.json", total_steps=192, **fields)
    before = contents(run.folder)
    line = fails(capsys, "train", "--resume", run.folder)
    assert "the checkpoint of step 128" in line
    assert "does not fit" in line
    assert "recipe.json" in line
    assert contents(run.folder) == before


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        *((text, "") for text in (b"\xff\xfe{", b"[" * 100_000, b"{}", b"[]")),
        (b'{"algorithm": ["ppo"]}', ""),
        (b'{"algorithm": "ppo", "backbone": {"network": "enhanced-tit"}}', "unknown field"),
    ],
)
def test_a_damaged_or_older_recipe_is_named(text, reason, tmp_path, capsys):
    run = untrained(tmp_path / "run", SMALL)
    (run.folder / "recipe.json").write_bytes(text)
    before = contents(run.folder)
    for words in (["train", "--resume"], ["evaluate"]):
        line = fails(capsys, *words, run.folder)
        assert "recipe.json cannot be read as a recipe" in line
        assert reason in line
    assert contents(run.folder) == before


@pytest.mark.parametrize(
    ("poison", "message"),
    [
        ({"critic_coeff": float("inf")}, "loss_critic became inf"),
        ({"learning_rate": 1e30}, "weights became (inf|nan)"),
    ],
)
def test_what_explodes_is_never_saved(poison, message, tmp_path):
    recipe = replace(SMALL, total_steps=192)
    run = train(replace(recipe, total_steps=64), tmp_path / "run")
    where = " in the update at step 128; the checkpoint of step 64 is good"
    with run, pytest.raises(FloatingPointError, match=message + where):
        runner.train(unchecked(recipe, **poison), run)
    assert latest_step(run.checkpoints) == 64
    assert len(read_metrics(run.folder / "metrics.csv")) == 1


def test_a_disk_that_is_full_stops_the_process_with_one_line(run, tmp_path):
    """The limit on a file's size stands for the disk; the metrics still fit, a checkpoint not."""
    edit(run.folder / "recipe.json", total_steps=256)
    before = contents(run.checkpoints)
    process = Command(["train", "--resume", run.folder], tmp_path / "errors", file_size=20_000)
    assert process.wait() == 2
    errors = process.errors.read_text()
    line = errors.splitlines()[-1]
    assert line.startswith("error: the checkpoint of step 192 could not be saved")
    assert "Traceback" not in errors
    assert contents(run.checkpoints) == before


def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path):
    (tmp_path / "recipe.json").write_text(recipe_to_json(replace(LONG, checkpoint_interval=10**6)))
    run = tmp_path / "run"
    process = Command(["train", tmp_path / "recipe.json", "--out", run], tmp_path / "errors")
    while len(read_metrics(run / "metrics.csv")) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    assert f"train --resume {run}" in process.errors.read_text()
    assert latest_step(run / "checkpoints") == read_metrics(run / "metrics.csv")[-1]["step"]
    assert not (run / "evaluation.json").exists()


@pytest.mark.slow
def test_killed_and_resumed_loses_nothing_that_was_saved(tmp_path):
    """Nor does it depend on the moment of the kill, but for the steps since the checkpoint."""
    (tmp_path / "recipe.json").write_text(recipe_to_json(replace(LONG, total_steps=64 * 14)))
    killed = tmp_path / "killed"
    process = Command(["train", tmp_path / "recipe.json", "--out", killed], tmp_path / "errors")
    while process.poll() is None and (latest_step(killed / "checkpoints") or 0) < 4 * 64:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    step = latest_step(killed / "checkpoints")
    shutil.copytree(killed, tmp_path / "copy")
    written = read_metrics(killed / "metrics.csv")
    rows = [str(row) for row in written if row["step"] <= (step or 0)]
    for folder in (killed, tmp_path / "copy"):
        process = Command(["train", "--resume", folder], tmp_path / "errors")
        assert process.wait() == 0, process.errors.read_text()
        said = f"note: resuming at step {step} with new episodes: environments are not saved"
        assert said in process.errors.read_text()
        assert [*map(str, read_metrics(folder / "metrics.csv"))][: len(rows)] == rows
    assert_same_run(Run.open(killed), Run.open(tmp_path / "copy"))


def test_of_two_that_begin_at_once_one_gets_the_folder(tmp_path, monkeypatch):
    """The second one finds no run yet, and the first one has begun to make it."""
    folder, refused = tmp_path / "run", list[object]()
    write = run_module.write_text_atomic

    def begin_another(path, text):
        if not refused:
            with pytest.raises(RuntimeError, match="in use by another process") as error:
                Run.create(folder, replace(SMALL, seed=1))
            refused.append(error)
        write(path, text)

    monkeypatch.setattr(run_module, "write_text_atomic", begin_another)
    Run.create(folder, SMALL)
    assert refused
    assert Run.open(folder).recipe == SMALL


def test_the_policy_plays_other_tasks_as_it_was_trained(run, capsys):
    own = run.read("evaluation.json")
    for options, episode, name in (
        (["--env", "CartPole-v0"], None, "evaluation_env-CartPole-v0.json"),
        (["--env-settings", "sutton_barto_reward=True"], -1.0, None),  # -1 at the end alone
        (["--env-settings", "max_episode_steps=3"], 3.0, "evaluation_max_episode_steps=3.json"),
    ):
        main(["evaluate", str(run.folder), *options])
        written = Path(capsys.readouterr().out.split("written to ")[1].strip())
        assert name in (None, written.name)
        evaluation = json.loads(written.read_text())
        assert evaluation["env"] == ("CartPole-v0" if "v0" in written.name else "CartPole-v1")
        assert episode is None or {*evaluation["returns"]} == {episode}
    assert run.read("evaluation.json") == own
    message = fails(capsys, "evaluate", run.folder, "--env", "MountainCar-v0")
    assert (
        "MountainCar-v0 has the observation UnboundedContinuous(shape=[2], dtype=float32)"
        in message
    )
    message = fails(capsys, "evaluate", run.folder, "--env", "Nowhere-v0")
    assert "Unknown task 'Nowhere-v0'" in message


def test_a_run_in_use_is_evaluated_into_another_file_only(tmp_path, capsys):
    run = untrained(tmp_path / "run", SMALL)
    record = Record(SMALL, make_algorithm(SMALL)).state_dict()
    run.save(64, {**run.load_trained()[1], "record": record})
    with run:
        assert "in use by another process" in fails(capsys, "evaluate", run.folder)
        main(["evaluate", str(run.folder), "--out", str(tmp_path / "elsewhere.json")])
    main(["evaluate", str(run.folder)])
    text = (run.folder / "evaluation.json").read_text()
    assert (tmp_path / "elsewhere.json").read_text() == text
