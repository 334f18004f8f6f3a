"""Tables of runs, which hold what run folders hold."""

import csv
import json
import lzma

import pytest
import torch

from recipes.cli import main
from recipes.core import records
from recipes.core.metrics import parse_metrics
from recipes.core.records import Records
from recipes.core.registry import find_recipe
from recipes.core.run import locked
from recipes.tools.results.experiments import find_runs, read_metrics
from recipes.tools.results.recording import record_runs
from recipes.tools.results.table import make_table
from tests.recipes.results.report_runs import metrics_of, write_run
from torchrl_tit.checkpoint import save_checkpoint

MLP = "ppo/cartpole/mlp"


@pytest.fixture
def runs(tmp_path):
    """Two seeds of a recipe, one with other settings, and one that was stopped."""
    folder = tmp_path / "runs"
    write_run(folder / "mlp" / "seed-2", MLP, 2, [500.0, 1 / 3])
    write_run(folder / "mlp" / "seed-10", MLP, 10, [480.0, 490.0])
    write_run(folder / "wide", MLP, 2, [9.0], num_envs=4)
    own = {"step": [1, 2], "time": [1.7e9, 1.7e9 + 4], "return_mean": [1.0, 2.0], "mine": [0, 5]}
    write_run(folder / "stopped", "ppo/cartpole/lstm", metrics=own)
    return folder


def test_a_table_is_read_as_the_folders_are(runs, tmp_path):
    out = tmp_path / "page"
    names = record_runs([runs], out)
    assert str(make_table([out])[0]) == str(make_table([runs])[0])  # NaN is not itself
    assert {run.recipe for run in find_runs([out])} == {run.recipe for run in find_runs([runs])}
    for before, after in zip(find_runs([runs]), find_runs([out]), strict=True):
        assert after.folder.relative_to(out) == before.folder.relative_to(runs)
        versions = [json.loads(run.read("versions.json") or "") for run in (before, after)]
        assert versions[0] == versions[1]
        for old, new in zip(read_metrics(before), read_metrics(after), strict=True):
            assert new == pytest.approx({k: old[k] for k in new}, rel=5e-4, nan_ok=True)
    assert names == ["mlp/seed-10", "mlp/seed-2", "stopped", "wide"]
    ((mlp,), _) = make_table([out / "mlp"])
    assert (mlp.runs, mlp.changes) == (2, "")
    row = Records(out).rows["wide"]
    assert (row["recipe"], json.loads(row["changes"])) == (MLP, {"num_envs": 4})
    assert find_recipe(str(out / "wide" / "recipe.json")) == find_runs([runs / "wide"])[0].recipe
    with pytest.raises(ValueError, match="holds no run folder and no table of runs"):
        find_runs([out / "narrow"])


def test_runs_from_the_weights_of_others_are_apart(tmp_path):
    write_run(tmp_path / "runs" / "scratch", MLP, 2, [500.0])
    for number, value in enumerate([400.0, 300.0]):
        rows = metrics_of(2, 50 + number)
        moved = write_run(tmp_path / "runs" / str(number), MLP, 2, [value], metrics=rows)
        save_checkpoint(moved / "initial_weights", 0, {"weight": torch.full((1,), value)})
    record_runs([tmp_path / "runs"], tmp_path / "page")
    for folder in ("runs", "page"):
        cells, _ = make_table([tmp_path / folder])
        found = {cell.mean: cell.changes for cell in cells}
        assert found[500.0] == ""
        assert found[400.0] != found[300.0]
        assert found[400.0].startswith("weights of another run, ")


def test_a_run_that_had_not_ended_is_replaced(runs, tmp_path, capsys):
    out = tmp_path / "page"
    main(["record", str(runs / "stopped"), "--out", str(out)])
    assert "stopped has not ended, or is not evaluated" in capsys.readouterr().err
    path = runs / "stopped" / "metrics.csv"
    path.write_text(path.read_text() + "3,1700000009,2.5,7\n")
    record_runs([runs / "stopped"], out)
    (run,) = find_runs([out])
    assert [row["step"] for row in read_metrics(run)] == [1, 2, 3]
    with pytest.raises(ValueError, match="holds stopped already"):
        record_runs([runs / "stopped"], out)
    for under in ("/elsewhere", "../up"):
        with pytest.raises(ValueError, match="must be a path below"):
            record_runs([runs / "wide"], out, under=under)
    with locked(out), pytest.raises(RuntimeError, match="in use by another process"):
        record_runs([runs / "wide"], out)


def test_a_run_that_is_evaluated_later_is_replaced(runs, tmp_path):
    run = runs / "wide"
    evaluation = (run / "evaluation.json").read_text()
    (run / "evaluation.json").unlink()
    record_runs([run], tmp_path / "page")
    (run / "evaluation.json").write_text(evaluation)
    record_runs([run], tmp_path / "page")
    [recorded] = find_runs([tmp_path / "page"])
    assert (recorded.read_evaluation() or {})["mean"] == json.loads(evaluation)["mean"]
    with pytest.raises(ValueError, match="holds wide already"):
        record_runs([run], tmp_path / "page")


def test_each_metric_that_is_kept_has_four_digits(runs, tmp_path):
    folder = runs / "stopped"
    (folder / "successes.csv").write_text("step,episodes,successes\n2,7,3\n")
    record_runs([folder], tmp_path / "page", under="trials")
    (run,) = find_runs([tmp_path / "page"])
    assert run.folder == tmp_path / "page" / "trials" / "stopped"
    rows = parse_metrics(run.read("metrics.csv"), run.folder)
    kept = {"step": 2, "return_mean": 2, "mine": 5, "steps_per_second": 0.25}
    assert rows[1] == {**kept, "episodes": 7, "successes": 3}
    assert run.read("evaluation.json") is None


def test_runs_are_added_in_any_order_and_once(runs, tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    record_runs([runs], one)
    record_runs([runs / "wide"], two)
    record_runs([runs / "mlp"], two, under="mlp")
    record_runs([runs / "stopped"], two)
    files = (records.TABLE, records.RECIPES, records.CURVES)
    assert [(one / name).read_bytes() for name in files] == [
        (two / name).read_bytes() for name in files
    ]
    for under in ("", "again"):
        with pytest.raises(ValueError, match=rf"holds {under}.*wide already, as wide"):
            record_runs([runs / "wide"], one, under=under)
    with pytest.raises(ValueError, match="two of the runs would be named wide"):
        record_runs([runs / "wide", runs], tmp_path / "three")


def test_a_table_apart_from_its_runs(runs, tmp_path):
    """Otherwise a folder would hold each of them twice."""
    for out in (runs, runs / "wide", runs / "wide" / "table", tmp_path):
        with pytest.raises(ValueError, match="so that it would count twice: name another folder"):
            record_runs([runs], out)
    assert not (runs / "wide" / "table").exists()
    assert not list(tmp_path.rglob(records.TABLE))


def test_a_table_is_whole_when_recording_is_interrupted(runs, tmp_path, monkeypatch):
    out = tmp_path / "page"
    record_runs([runs / "mlp"], out)
    before = str(make_table([out]))

    def fail(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(records, "write_text_atomic", fail)
    with pytest.raises(KeyboardInterrupt):
        record_runs([runs / "wide"], out)
    assert str(make_table([out])) == before


def test_commands_take_tables(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["record", "runs/mlp", "--out", "page", "--commit", "abc"])
    assert capsys.readouterr().out.endswith("page/seed-2\n2 recorded in page\n")
    assert Records("page").rows["seed-2"]["commit"] == "abc"
    main(["table", "page"])
    assert f"| {MLP} | 2 | 368 ± 166 |" in capsys.readouterr().out
    main(["compare", "page/seed-2", "page/seed-10", "--out", "a.png"])
    capsys.readouterr()
    main(["show", "page/seed-2/recipe.json"])
    assert json.loads(capsys.readouterr().out)["seed"] == 2


DAMAGE = {
    "larger than a table": (records.CURVES, b"run,step\n" + bytes(2**26), "more than the 67108864"),
    "a cell that is too large": (records.CURVES, b"run,step\nseed-2," + b"0" * 200_000, "limit"),
    "a row that is too short": (records.CURVES, b"run,step,return_mean\nseed-2,1,2\nseed-2\n", ""),
    "a row without cells": (records.CURVES, b"run,step\n\n", ""),
    "nested too deeply": (records.RECIPES, b"[" * 100_000, "recursion"),
    "no object": (records.RECIPES, b"[1, 2]", ""),
    "cut off": (records.CURVES, None, ""),
    "no recipes": (records.RECIPES, None, ""),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_damaged_tables_are_refused(what, runs, tmp_path):
    name, content, message = DAMAGE[what]
    out = tmp_path / "page"
    record_runs([runs / "mlp"], out)
    whole = (out / name).read_bytes()
    (out / name).write_bytes(whole[:-20] if content is None else lzma.compress(content, preset=0))
    with pytest.raises(ValueError, match=rf"{name} is damaged: .*{message}"):
        [read_metrics(run) for run in find_runs([out])]


@pytest.mark.parametrize(
    ("column", "value"), [("seed", "two"), ("mean", "{"), ("evaluation", "[1]")]
)
def test_rows_of_others_are_refused(column, value, runs, tmp_path):
    out = tmp_path / "page"
    record_runs([runs / "mlp" / "seed-2"], out)
    with (out / records.TABLE).open(newline="") as file:
        (row,) = csv.DictReader(file)
    with (out / records.TABLE).open("w", newline="") as file:
        writer = csv.DictWriter(file, records.COLUMNS)
        writer.writeheader()
        writer.writerow(row | {column: value})
    with pytest.raises(ValueError, match=str(out)):
        make_table([out])


def test_runs_without_metrics_are_not_recorded(tmp_path):
    write_run(tmp_path / "run", MLP, metrics={name: [] for name in metrics_of(0)})
    with pytest.raises(ValueError, match="has no metrics yet"):
        record_runs([tmp_path / "run"], tmp_path / "page")
