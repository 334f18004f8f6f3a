"""Success on memory tasks as pictures: while training, and in T-Mazes of several lengths."""

import numpy as np
import pytest

from benchmarks.memory_pictures import main, plot_curves, plot_lengths
from recipes.core.recipe_json import recipe_to_json
from recipes.core.registry import get_recipe

SHORT, LONG = [(100, 50), (200, 100)], [(100, 50), (200, 100), (400, 0)]
"""Step and successes of 100 episodes each."""
ROWS = """recipe,seed,weights,steps,steps_to_0.9,success,return
ppo/tmaze-50/lstm,0,9,100,,0.4,0.4
ppo/tmaze-50/lstm,1,9,100,,0.6,0.6
ppo/tmaze-10/lstm,0,9,100,,1.0,1.0
ppo/memory-s7/lstm,0,9,100,,0.7,0.7
ppo/tmaze-10/enhanced-tit,0,9,100,,0.9,0.9
"""


@pytest.fixture
def make_run(tmp_path):
    def make(name, seed, batches):
        folder = tmp_path / name / f"seed-{seed}"
        folder.mkdir(parents=True)
        (folder / "recipe.json").write_text(recipe_to_json(get_recipe(name)))
        rows = "".join(f"{step},100,{right}\n" for step, right in batches)
        (folder / "successes.csv").write_text("step,episodes,successes\n" + rows)
        return folder

    return make


def drawn(axes):
    return {str(line.get_label()): np.asarray(line.get_data()) for line in axes.lines}


def test_a_run_that_ended_keeps_its_last_value(make_run):
    runs = [make_run("ppo/memory-s7/lstm", *run) for run in enumerate([SHORT, LONG])]
    [axes] = plot_curves(runs).axes
    assert axes.get_title() == "memory-s7"
    [(label, (steps, values))] = drawn(axes).items()
    assert label == "lstm (2)"
    assert np.allclose(steps[[0, -1]], [0.1, 0.4])  # thousands
    assert np.allclose(values[[0, -1]], [0.5, 0.5])  # in the end, 1 and 0
    assert np.allclose(np.interp([0.15, 0.3], steps, values), [0.75, 0.75], atol=0.01)
    band = np.asarray(axes.collections[0].get_paths()[0].vertices)
    assert (band[:, 1].min(), band[:, 1].max()) == (0, 1)


def test_a_panel_a_task_and_a_color_a_network(make_run):
    names = ["ppo/memory-s9/lstm", "ppo/memory-s7/lstm", "ppo/memory-s7/enhanced-tit"]
    panels = plot_curves([make_run(name, 0, SHORT) for name in names]).axes
    assert [axes.get_title() for axes in panels] == ["memory-s7", "memory-s9"]
    lines = [[(str(x.get_label()), x.get_color()) for x in axes.lines] for axes in panels]
    assert lines == [[("enhanced-tit (1)", "C0"), ("lstm (1)", "C1")], [("lstm (1)", "C1")]]


def test_means_in_order_of_length_and_a_mark_a_seed(tmp_path):
    (tmp_path / "runs.csv").write_text(ROWS)
    [axes] = plot_lengths(tmp_path / "runs.csv").axes
    lines = [(line.get_label(), np.asarray(line.get_data()).tolist()) for line in axes.lines[1:]]
    names = [name for name, _ in lines if not str(name).startswith("_")]
    assert names == ["enhanced-tit", "lstm"]  # the first line is a guess
    [(_, [[first], _]), _, (_, [places, means]), (_, ten), (_, fifty)] = lines
    assert means == [1.0, 0.5]
    assert np.allclose(places, [10, 50], rtol=0.1)
    assert ten == [[places[0]], [1.0]]
    assert fifty == [[places[1]] * 2, [0.4, 0.6]]
    assert first < 10 < places[0]  # side by side


def test_the_command(make_run, tmp_path, capsys):
    out, rows = tmp_path / "a.png", tmp_path / "runs.csv"
    rows.write_text(ROWS.splitlines()[0])
    main(["curves", str(make_run("ppo/memory-s7/lstm", 0, SHORT)), "--out", str(out)])
    assert out.read_bytes().startswith(b"\x89PNG")
    for what, path, said in [
        ("curves", tmp_path / "nothing", "holds no run folder"),
        ("curves", make_run("ppo/memory-s9/lstm", 1, []), "has fewer than a hundred episodes"),
        ("lengths", rows, "has no run on a T-Maze"),
    ]:
        with pytest.raises(SystemExit):
            main([what, str(path), "--out", str(tmp_path / "none.png")])
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()
