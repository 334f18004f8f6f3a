"""Every benchmark of the networks runs, at sizes that take seconds, and compares like with like."""

import json
from itertools import pairwise

import pytest
import torch
from torchrl.modules import set_recurrent_mode

from benchmarks import acting, export, memory, segments, training_step
from benchmarks.__main__ import BENCHMARKS, gather
from benchmarks.cases import Case, same_number_of_weights
from benchmarks.earlier import earlier_tree
from benchmarks.matrix_peak import count_flops, peak_flops
from benchmarks.straightforward_ratios import HEADER, cells
from tests.numerics import assert_near
from torchrl_tit.modules import Backbone

CASES = [
    Case("Enhanced", "arrays", 4, 3),
    Case("Vanilla", "arrays", 4, 3),
    Case("Enhanced", "images", 4, 2),
    Case("Vanilla", "images", 1, 2),
]


@pytest.mark.parametrize("case", [*acting.CASES, *training_step.CASES])
def test_both_networks_have_the_same_weights(case):
    assert same_number_of_weights(case)


@pytest.mark.parametrize("case", CASES)
def test_acting(case):
    row = acting.measure(case, steps=2, repeats=2)
    assert len(cells(row, ms_digits=2, ratio_digits=1)) == len(HEADER)
    assert row["ours_ratios"] == [
        b / a for a, b in zip(row["ours_ms"], row["straightforward_ms"], strict=True)
    ]


def test_growth_with_the_history():
    assert len(acting.growth(CASES[0], steps=2, repeats=3)) == 3


def test_windows_move_on_and_start_anew():
    case = Case("Enhanced", "arrays", 4, 3)
    windows = acting.make_windows(case, 14)
    for before, after in pairwise(windows):
        assert torch.equal(before[1:, 1:], after[1:, :-1])
    assert torch.equal(windows[10][0, :3], windows[10][0, 3:].expand(3, -1))  # a new episode
    assert not torch.equal(windows[9][0, 1:], windows[10][0, :-1])
    backbone = Backbone(case.ours()).eval()
    with torch.no_grad(), backbone.acting():
        for window in windows:
            features = backbone(window)
            assert_near(features, backbone.module(window))


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("case", CASES[:3])
def test_training_step(case, bfloat16):
    row = training_step.measure(case, 2, 0.0, compiled=False, bfloat16=bfloat16)
    assert len(row["ours_ratios"]) == 2
    assert len(cells(row, ms_digits=1, ratio_digits=2)) == len(HEADER)


def test_segments_hold_the_windows_that_the_peers_read():
    case = Case("Enhanced", "arrays", 4, 32)
    steps = segments.make_segments(case, 16)
    assert steps.shape == (2, 16)
    frames = torch.cat([steps["history"][:, 0], steps["observation"][:, 1:]], dim=1)
    windows = frames.unfold(1, 4, 1).movedim(-1, 2).flatten(0, 1)
    network = case.ours()
    backbone = Backbone(network, padding="same")
    with set_recurrent_mode(True):
        features = backbone(steps)["features"]
    assert_near(features.flatten(0, 1), network(windows))


@pytest.mark.slow
def test_segments_against_full_windows_of_the_earlier_commit():
    row = segments.Row(Case("Enhanced", "arrays", 4, 32), length=16, straightforward=True)
    try:
        with earlier_tree() as tree:
            result = segments.measure(row, tree, rounds=2, seconds=0.0)
    except SystemExit:
        pytest.skip("this is no full clone")
    assert set(result["ms"]) == {"segments", "full windows", "straightforward"}
    assert all(len(times) == 2 for times in result["ms"].values())
    assert len(segments.cells(result, rate=1e9)) == 10


@pytest.mark.slow
def test_exported_policies_act_as_the_live_one(monkeypatch):
    pytest.importorskip("onnxruntime")
    taken: dict[int, list[torch.Tensor]] = {}
    seconds = export.seconds

    def recording(act, frames, num_frames):
        steps = range(num_frames, frames.shape[1] + 1)
        actions = [act(frames[:, :step], step == num_frames) for step in steps]
        taken.setdefault(len(frames), []).append(torch.stack(actions))
        return seconds(act, frames, num_frames)

    monkeypatch.setattr(export, "seconds", recording)
    found = export.measure(Case("Enhanced", "arrays", 3, max(export.SIZES)), steps=4, repeats=1)
    assert list(found) == ["live", "pt2", "pt2, step by step", "onnx", "onnx, step by step"]
    for row in found.values():
        assert all(rate > 0 for rates in row["rates"].values() for rate in rates)
    for actions in taken.values():
        assert len(actions) == len(found)
        for others in actions[1:]:  # step by step, the window begins with one frame
            assert torch.equal(others[2:].to(actions[0].dtype), actions[0][2:])


def test_operations_of_matrix_products_are_counted():
    a = torch.randn(3, 5, requires_grad=True)
    b = torch.randn(5, 7, requires_grad=True)
    # The product, and one more for the gradient of each factor.
    assert count_flops(lambda: (a @ b).sum().backward()) == 3 * 2 * 3 * 5 * 7
    assert peak_flops("cpu", torch.float32, size=16, repeats=2) > 0


def test_memory_counts_what_is_stored():
    stream = memory.make_stream((84, 84), torch.uint8, 300)
    frame = 84 * 84
    assert memory.stacked_bytes(stream, 4) == pytest.approx(8 * frame, rel=0.01)
    assert memory.our_bytes(stream, 4) == pytest.approx(frame, rel=0.02)


def test_results_are_gathered(tmp_path):
    for name in BENCHMARKS:
        (tmp_path / f"{name}.md").write_text(f"# {name}\n")
        (tmp_path / f"{name}.json").write_text('{"a": 1}')
    gather(tmp_path)
    text = (tmp_path / "benchmarks.md").read_text()
    assert all(f"# {name}\n" in text for name in BENCHMARKS)
    assert set(json.loads((tmp_path / "benchmarks.json").read_text())) == set(BENCHMARKS)
