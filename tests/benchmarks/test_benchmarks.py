"""Every benchmark of the networks runs, at sizes that take seconds, and compares like with like."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.modules import set_recurrent_mode

from benchmarks import (
    acting,
    export,
    history_windows,
    measuring,
    memories,
    off_policy,
    segments,
    sliding,
    window_tables,
)
from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.straightforward import Case
from docs.tools import tables
from tests.numerics import assert_near
from torchrl_tit.histories.outer import ChainedOuterTransformer
from torchrl_tit.modules import Backbone

CASES = [
    Case("Enhanced", "arrays", 4, 3),
    Case("Vanilla", "arrays", 4, 3),
    Case("Enhanced", "images", 1, 2),
    Case("Vanilla", "images", 4, 2),
]


def test_pages_quote_what_make_bench_measures():
    """Each record is made by a benchmark, and a page has numbers of it."""
    records = {path.stem for path in (tables.RESULTS / "benchmarks").glob("*.json")}
    pages = "".join(path.read_text() for path in tables.ROOT.glob("docs/*.md"))
    assert records == {*BENCHMARKS}
    assert {name for name in records if f"benchmarks/{name}.json" in pages} == records


def test_records_have_the_rows_of_the_benchmarks_in_order():
    """Pages read these rows by their places."""
    places: dict[str, list[tuple[Case, dict[str, int]]]] = {
        "acting": [(case, {}) for case in acting.CASES],
        "segments": [(row.case, {"length": row.length}) for row in segments.ROWS],
    }
    for name, cases in places.items():
        rows = json.loads((tables.RESULTS / "benchmarks" / f"{name}.json").read_text())["rows"]
        for row, (case, further) in zip(rows, cases, strict=True):
            expected = {**case.record(), **further}
            assert {entry: row[entry] for entry in expected} == expected


@pytest.mark.parametrize("case", CASES)
def test_both_networks_have_the_same_weights(case):
    counts = [
        sum(weight.numel() for weight in network.parameters())
        for network in (case.ours(), case.straightforward())
    ]
    assert counts[0] == counts[1]


@pytest.mark.parametrize("case", CASES[:3])
def test_acting(case):
    row = acting.measure(case, rounds=2, seconds=0, compiled=False)
    ratios = measuring.ratios(row["straightforward_ms"], row["ours_ms"])
    assert row["ours_ratios"] == ratios


def test_segments_hold_the_windows_that_the_peers_read():
    case = Case("Enhanced", "arrays", 4, 32)
    steps = segments.make_segments(case, 16)
    assert steps.shape == (2, 16)
    frames = torch.cat([steps["history"][:, 0], steps["observation"][:, 1:]], dim=1)
    windows = frames.unfold(1, 4, 1).movedim(-1, 2).flatten(0, 1)
    network = case.ours()
    with set_recurrent_mode(True):
        features = Backbone(network, padding="same")(steps)["features"]
    assert_near(features.flatten(0, 1), network(windows))


def test_segments_against_full_windows():
    row = segments.Row(Case("Enhanced", "arrays", 4, 32), length=16)
    result = segments.measure(row, rounds=2, seconds=0)
    assert set(result["ms"]) == {"segments", "straightforward"}
    assert all(len(times) == 2 for times in result["ms"].values())


def test_on_another_device_nothing_is_on_the_cpu(monkeypatch, capsys):
    """On "meta", a mixture of devices is refused."""
    ticks = iter(range(1000))
    monkeypatch.setattr(measuring, "clock", lambda device: next(ticks))
    monkeypatch.setattr(torch.optim, "Adam", lambda weights, fused: torch.optim.SGD(weights))
    with torch.device("meta"):
        segments.measure(segments.Row(Case("Enhanced", "images", 4, 32), length=16), 1, 0)
        memories.training(memories.make_backbone("gtrxl", 8), 8)()
    with pytest.raises(SystemExit):
        main(["offline", "--device", "meta"])
    assert "['offline'] run on the CPU only" in capsys.readouterr().err


def test_window_tables_agree_with_copies(monkeypatch):
    numbers = window_tables.main(num_frames=[2, 8], seconds=0)
    for found in numbers.values():
        assert min(found["ratios"]) > 0
    read = window_tables.read
    monkeypatch.setattr(window_tables, "read", lambda n, table, x: read(n, table, x) + table)
    with pytest.raises(AssertionError, match="not close"):
        window_tables.main(num_frames=[8], seconds=0)


def test_memories_forget_where_an_episode_begins(monkeypatch):
    names = ["lstm", "mingru", "enhanced-tit"]
    for name in names:
        backbone = memories.make_backbone(name, 6).eval()
        steps = memories.make_sequences(backbone, 6, samples=12)
        seen = steps["observation"].clone()
        seen[:, :2] = 1
        other = steps.copy().set("observation", seen)
        first = seen if backbone.is_recurrent else seen[:, :1]
        other["history"] = first.unsqueeze(2).expand_as(steps["history"])
        with set_recurrent_mode(True):
            features = [backbone(x)["features"] for x in (steps, other)]
        assert_near(features[0][:, 2:], features[1][:, 2:])
        assert (features[0] - features[1])[:, :2].abs().max() > 1e-3
    monkeypatch.setattr(memories, "SAMPLES", 12)
    for row in memories.main([6], names, seconds=0).values():
        assert len(row) == 2
        assert all(time > 0 for times in row.values() for time in times)


def test_sliding_blocks_are_measured_on_their_tables(monkeypatch):
    monkeypatch.setattr(memories, "SAMPLES", 12)
    monkeypatch.setattr(sliding, "ATTENDED", 3)
    history: Any = sliding.HISTORIES["chained, sliding"]
    history = replace(history, attention_frames=3)
    monkeypatch.setitem(sliding.HISTORIES, "chained, sliding", history)
    tables, read_table = [], ChainedOuterTransformer.read_table

    def counted(*arguments):
        tables.append(arguments)
        return read_table(*arguments)

    monkeypatch.setattr(ChainedOuterTransformer, "read_table", counted)
    rows = sliding.main(length=6, seconds=0)
    assert tables
    for row in rows.values():
        assert all(time > 0 for times in row.values() for time in times)


@pytest.mark.slow
def test_exported_policies_act_as_the_live_one(monkeypatch):
    pytest.importorskip("onnxruntime")
    taken: dict[int, dict[str, torch.Tensor]] = {}

    def take_turns(steps, rounds, seconds):
        actions = {name: torch.stack(step()) for name, step in steps.items()}
        taken[actions["live"].shape[1]] = actions
        return measuring.take_turns(steps, rounds, seconds)

    monkeypatch.setattr(export, "take_turns", take_turns)
    found = export.measure(Case("Enhanced", "arrays", 3, max(export.SIZES)), steps=4, rounds=1)
    assert list(found) == ["live", "pt2", "pt2, step by step", "onnx", "onnx, step by step"]
    for row in found.values():
        assert all(rate > 0 for rates in row["rates"].values() for rate in rates)
    for live, *others in (actions.values() for actions in taken.values()):
        for other in others:  # step by step, the window begins with one frame
            assert torch.equal(other[2:].to(live.dtype), live[2:])


def test_bytes_of_what_is_stored():
    stream = history_windows.make_stream((84, 84), torch.uint8, 300)
    ours, stacked = history_windows.bytes_per_step(stream, 4)
    assert stacked == pytest.approx(8 * 84 * 84, rel=0.01)
    assert ours == pytest.approx(84 * 84, rel=0.02)


def test_rows_are_measured_once(tmp_path, capsys):
    path, measured = tmp_path / "new" / "rows.csv", []

    def measure(name, seed):
        measured.append((name, seed))
        return [name, seed, 0.5]

    for seeds in ([0], [0, 1]):
        runs = [(name, seed) for seed in seeds for name in "ab"]
        measuring.add_missing_rows(path, ["name", "seed", "value"], runs, measure)
    assert measured == [("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert measuring.read_rows(path)[-1] == {"name": "b", "seed": "1", "value": "0.5"}
    assert capsys.readouterr().out.startswith("a 0 0.5\n")


def test_policies_are_ranked_by_discounted_returns():
    assert off_policy.discounted(np.array([2.0, 3.0]), 0.5).tolist() == [1.5, 1.75]


def test_nested_numbers_are_a_table():
    times = {"one": {"ms": [1.0, 3.0, 200.0], "of": {"what": "x"}}, "two": {"ms": [0.12345]}}
    lines = measuring.summary(times).splitlines()
    assert lines[0] == "|  | ms | of / what |"
    assert lines[2:] == ["| one | 3 (1 to 200) | x |", "| two | 0.123 (0.123 to 0.123) |  |"]
    assert measuring.summary({"rows": [{"K": 4, "ms": 2.0}]}).splitlines()[2] == "| 4 | 2 |"


def test_the_command(tmp_path, monkeypatch, capsys):
    for name in set(BENCHMARKS) - {"offline"}:  # which needs d3rlpy
        module = importlib.import_module(f"benchmarks.{name}")
        monkeypatch.setattr(module, "main", lambda: {"a": {"ms": [1.0, 2.0]}})
    main(["acting", "segments", "--out", str(tmp_path)])
    for name in ("acting", "segments"):
        assert json.loads((tmp_path / f"{name}.json").read_text())["a"] == {"ms": [1.0, 2.0]}
        assert "| a | 1.5 (1.0 to 2.0) |" in (tmp_path / f"{name}.md").read_text()
    assert "A step of acting: " in capsys.readouterr().out  # what is measured
    (tmp_path / "file").touch()
    for words, reason in [
        (["nothing"], "unknown benchmark ['nothing']: choose from acting"),
        (["acting", "--out", str(tmp_path / "file")], "is a file: name a folder"),
    ]:
        with pytest.raises(SystemExit):
            main(words)
        assert reason in capsys.readouterr().err
