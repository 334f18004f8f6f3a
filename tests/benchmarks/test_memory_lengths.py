"""Success in T-Mazes of several lengths, as a picture."""

import numpy as np
import pytest

from benchmarks.memory_lengths import main, plot_lengths, read_successes

ROWS = """recipe,seed,weights,steps,steps_to_0.9,success,return
ppo/tmaze-50/lstm,0,9,100,,0.4,0.4
ppo/tmaze-50/lstm,1,9,100,,0.6,0.6
ppo/tmaze-10/lstm,0,9,100,,1.0,1.0
ppo/memory-s7/lstm,0,9,100,,0.7,0.7
ppo/tmaze-10/enhanced-tit,0,9,100,,0.9,0.9
"""


@pytest.fixture
def runs(tmp_path):
    path = tmp_path / "runs.csv"
    path.write_text(ROWS)
    return path


def test_means_in_order_of_length_and_a_dot_a_seed(runs):
    [axes] = plot_lengths(read_successes(runs)).axes
    lines = {line.get_label(): line for line in axes.lines[1:]}  # the first is a guess
    assert list(lines) == ["enhanced-tit", "lstm"]
    assert np.array_equal(lines["lstm"].get_xdata(), [10, 50])
    assert np.allclose(lines["lstm"].get_ydata(), [1.0, 0.5])
    dots = axes.collections[1].get_offsets()
    assert np.allclose(np.asarray(dots), [[10, 1.0], [50, 0.4], [50, 0.6]])


def test_the_command(runs, tmp_path, capsys):
    main([str(runs), "--out", str(tmp_path / "lengths.png")])
    assert (tmp_path / "lengths.png").read_bytes().startswith(b"\x89PNG")
    runs.write_text(ROWS.splitlines()[0])
    with pytest.raises(SystemExit):
        main([str(runs), "--out", str(tmp_path / "none.png")])
    assert "has no run on a T-Maze" in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()
