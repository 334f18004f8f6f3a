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


def test_means_in_order_of_length_and_a_mark_a_seed(runs):
    [axes] = plot_lengths(read_successes(runs)).axes
    drawn = [(line.get_label(), np.asarray(line.get_data()).tolist()) for line in axes.lines[1:]]
    names = [name for name, _ in drawn if not str(name).startswith("_")]
    assert names == ["enhanced-tit", "lstm"]  # the first line is a guess
    [(_, [[first], _]), _, (_, [places, means]), (_, ten), (_, fifty)] = drawn
    assert means == [1.0, 0.5]
    assert np.allclose(places, [10, 50], rtol=0.1)
    assert ten == [[places[0]], [1.0]]
    assert fifty == [[places[1]] * 2, [0.4, 0.6]]
    assert first < 10 < places[0]  # side by side


def test_the_command(runs, tmp_path, capsys):
    main([str(runs), "--out", str(tmp_path / "lengths.png")])
    assert (tmp_path / "lengths.png").read_bytes().startswith(b"\x89PNG")
    runs.write_text(ROWS.splitlines()[0])
    with pytest.raises(SystemExit):
        main([str(runs), "--out", str(tmp_path / "none.png")])
    assert "has no run on a T-Maze" in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()
