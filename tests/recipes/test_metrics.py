"""Metrics as CSV and TensorBoard, over the end and the new start of a process."""

import math

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from recipes.core.metrics import Metrics, read_metrics


def scalars(folder, name):
    events = EventAccumulator(str(folder / "tensorboard")).Reload()
    return [(event.step, event.value) for event in events.Scalars(name)]


def write(folder, rows, last_step=0):
    metrics = Metrics(folder, ["loss", "return"], last_step)
    for step, loss, value in rows:
        metrics.log(step, **{"loss": loss, "return": value})
    metrics.close()


def test_numbers_come_back_exactly_and_nan_is_not_drawn(tmp_path):
    write(tmp_path, [(64, 1 / 3, math.nan), (128, 1e-30, 9.0)])
    first, second = read_metrics(tmp_path / "metrics.csv")
    assert (first["step"], first["loss"]) == (64, 1 / 3)
    assert math.isnan(first["return"])
    assert (second["step"], second["loss"], second["return"]) == (128, 1e-30, 9.0)
    assert [step for step, _ in scalars(tmp_path, "loss")] == [64, 128]
    assert scalars(tmp_path, "return") == [(128, 9.0)]


def test_rows_that_stay_are_not_changed_and_later_ones_are_cut(tmp_path):
    write(tmp_path, [(64, 1 / 3, math.nan), (128, 2, 9.0), (192, 0.5, 8.0)])
    before = (tmp_path / "metrics.csv").read_text().splitlines()
    write(tmp_path, [(192, 0.25, 7.0)], last_step=128)
    after = (tmp_path / "metrics.csv").read_text().splitlines()
    assert after[:3] == before[:3]
    assert [row["loss"] for row in read_metrics(tmp_path / "metrics.csv")] == [1 / 3, 2, 0.25]
    assert scalars(tmp_path, "return") == [(128, 9.0), (192, 7.0)]


def test_the_time_of_pauses_is_not_that_of_steps(tmp_path, monkeypatch):
    clock = iter([0.0, 1.0, 9.0, 10.0])
    monkeypatch.setattr("recipes.core.metrics.time.monotonic", lambda: next(clock))
    metrics = Metrics(tmp_path, ["loss"], last_step=0)
    with metrics.paused():
        pass  # from 1 to 9
    assert metrics.log(64, loss=1.0)["steps_per_second"] == 64 / 2
    metrics.close()


def test_a_process_killed_while_it_opens_loses_no_row(tmp_path, monkeypatch):
    write(tmp_path, [(64, 1.0, 2.0), (128, 3.0, 4.0)])
    before = (tmp_path / "metrics.csv").read_bytes()

    def killed(*_):
        raise SystemExit

    monkeypatch.setattr(Metrics, "_draw", killed)
    with pytest.raises(SystemExit):
        Metrics(tmp_path, ["loss", "return"], last_step=128)
    assert (tmp_path / "metrics.csv").read_bytes() == before


def test_no_file_is_no_rows_and_a_torn_last_row_is_none(tmp_path):
    assert read_metrics(tmp_path / "metrics.csv") == []
    write(tmp_path, [(64, 1.0, 2.0)])
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("128,17000")
    assert len(read_metrics(tmp_path / "metrics.csv")) == 1
    write(tmp_path, [(128, 5.0, 6.0)], last_step=64)
    assert [row["loss"] for row in read_metrics(tmp_path / "metrics.csv")] == [1.0, 5.0]


@pytest.mark.parametrize(
    ("text", "after"),
    [
        *((f"{{}}{row}\n", "step 64") for row in ("128,1.0", "128,1.0,high,3", "128,1.0,2,3,4,5")),
        *(("time,loss\n1,2\n", "its beginning"), ("step,loss\ninf,2\n", "its beginning")),
        *((f"step,loss\n1,{'2' * 200_000}\n", "its beginning"), ("\xff", "its beginning")),
    ],
)
def test_what_is_damaged_is_named(text, after, tmp_path):
    write(tmp_path, [(64, 1.0, 2.0)])
    path = tmp_path / "metrics.csv"
    path.write_text(text.format(path.read_text()), encoding="latin-1")
    with pytest.raises(ValueError, match=rf"metrics\.csv has a damaged row after {after}"):
        read_metrics(path)


def test_metrics_of_another_run_are_refused_and_stay(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,time,steps_per_second,loss\n64,1.0,9.0,2.0\n")
    with pytest.raises(ValueError, match=r"no column 'return'"):
        Metrics(tmp_path, ["loss", "return"], last_step=64)
    assert path.read_text() == "step,time,steps_per_second,loss\n64,1.0,9.0,2.0\n"
