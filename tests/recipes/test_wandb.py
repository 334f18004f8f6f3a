"""Metrics on Weights & Biases, offline, read back from the file that it would upload."""

import json
import math
import struct
import time
from dataclasses import replace
from importlib import import_module

import pytest

from recipes.cli import main
from recipes.core.metrics import read_metrics
from recipes.core.recipe_json import recipe_to_json
from recipes.core.run import Run
from recipes.tools.wandb_metrics import WandbMetrics
from tests.recipes.commands import fails
from tests.recipes.small import TINY

RECIPE = replace(TINY, name="ppo/cartpole/mine")
_BLOCK = 32768


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")


def records(file):
    """What W&B keeps in a file: LevelDB's log format, after 7 bytes of its own."""
    Record = import_module("wandb.proto.wandb_internal_pb2").Record
    content, place, parts = file.read_bytes(), 7, b""
    while place + 7 <= len(content):
        if _BLOCK - place % _BLOCK < 7:
            place += _BLOCK - place % _BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", content, place)
        parts += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # a whole record, or the last part of one
            record = Record()
            record.ParseFromString(parts)
            yield record
            parts = b""


def finished(file):
    """The records of a file, once W&B's own process has written the last one."""
    for _ in range(300):
        found = list(records(file))
        if found and found[-1].WhichOneof("record_type") == "exit":
            return found
        time.sleep(0.1)
    raise TimeoutError(f"{file} has no end")


def uploads(folder):
    """The rows and the summary of all processes that wrote to a run, by the run's names."""
    rows, summary, names, config = [], {}, set(), {}
    for file in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        for record in finished(file):
            kind = record.WhichOneof("record_type")
            if kind == "history":
                items = {".".join(i.nested_key) or i.key: i.value_json for i in record.history.item}
                rows.append({name: json.loads(value) for name, value in items.items()})
            if kind == "summary":
                for item in record.summary.update:
                    summary[".".join(item.nested_key) or item.key] = json.loads(item.value_json)
            if kind == "run":
                names.add((record.run.project, record.run.run_id))
                for item in record.run.config.update:
                    config[item.key] = json.loads(item.value_json)
    return rows, summary, names, config


def test_rows_of_a_run_that_is_trained_further(tmp_path):
    (tmp_path / "recipe.json").write_text(recipe_to_json(RECIPE))
    run = tmp_path / "run"
    main(["train", str(tmp_path / "recipe.json"), "--out", str(run), "--wandb", "mine"])
    main(["train", "--resume", str(run), "--total-steps", "192", "--wandb", "mine"])
    rows, summary, names, config = uploads(run)
    expected = read_metrics(run / "metrics.csv")
    assert [row["step"] for row in rows] == [row["step"] for row in expected] == [64, 128, 192]
    for row, known in zip(rows, expected, strict=True):
        for name, value in known.items():
            if name != "time":
                assert row.get(name, math.nan) == pytest.approx(value, rel=1e-6, nan_ok=True), name
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert summary["evaluation"] == evaluation["mean"]
    assert summary["evaluation_step"] == 192
    assert names == {("mine", json.loads((run / "wandb.json").read_text())["id"])}
    assert config["env"] == "CartPole-v1"
    assert list((run / "tensorboard").iterdir()), "W&B stands beside TensorBoard"


def test_a_run_that_is_sent_for_the_first_time_sends_its_earlier_rows(tmp_path):
    run = Run.create(tmp_path / "run", RECIPE)
    (run.folder / "metrics.csv").write_text("step,time,return_mean\n32,5,1.5\n64,6,nan\n")
    metrics = WandbMetrics(run, "mine")
    metrics.logged(64, {"step": 64, "return_mean": 9.0})  # again, after a kill
    metrics.logged(96, {"step": 96, "return_mean": 2.5})
    metrics.close()
    rows, *_ = uploads(run.folder)
    found = [(row["step"], row.get("return_mean")) for row in rows]
    assert found == [(32, 1.5), (96, 2.5)]


def test_what_cannot_be_sent(tmp_path, capsys, monkeypatch):
    (tmp_path / "recipe.json").write_text(recipe_to_json(RECIPE))
    words = ["train", tmp_path / "recipe.json", "--out", tmp_path / "run", "--wandb"]
    assert "not 'a/b'" in fails(capsys, *words, "a/b")
    with monkeypatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda name: None)
        assert "pip install 'torchrl-tit[wandb]'" in fails(capsys, *words, "mine")
    assert not (tmp_path / "run").exists(), "nothing was begun"

    run = Run.create(tmp_path / "run", RECIPE)
    (run.folder / "wandb.json").write_text('{"project": "other", "id": "abc"}')
    assert "is in the project 'other' already" in fails(
        capsys, "train", "--resume", run.folder, "--wandb", "mine"
    )
    (run.folder / "wandb.json").write_text("[]")
    assert "wandb.json is damaged" in fails(
        capsys, "train", "--resume", run.folder, "--wandb", "mine"
    )
