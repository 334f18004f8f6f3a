"""Curves of success over training, as a picture."""

import numpy as np
import pytest

from benchmarks.memory_curves import main, plot_curves, read_curves
from recipes.recipe_json import recipe_to_json
from recipes.registry import get_recipe

SHORT, LONG = [(100, 50), (200, 100)], [(100, 50), (200, 100), (400, 0)]
"""Step and successes of 100 episodes each."""


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
    runs = [
        make_run("ppo/memory-s7/lstm", seed, batches) for seed, batches in enumerate([SHORT, LONG])
    ]
    [axes] = plot_curves(read_curves(runs)).axes
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
    panels = plot_curves(read_curves([make_run(name, 0, SHORT) for name in names])).axes
    assert [axes.get_title() for axes in panels] == ["memory-s7", "memory-s9"]
    assert [sorted(drawn(axes)) for axes in panels] == [
        ["enhanced-tit (1)", "lstm (1)"],
        ["lstm (1)"],
    ]
    colors = {
        line.get_color()
        for axes in panels
        for line in axes.lines
        if "lstm" in str(line.get_label())
    }
    assert len(colors) == 1


def test_the_command(make_run, tmp_path, capsys):
    run, out = make_run("ppo/memory-s7/lstm", 0, SHORT), tmp_path / "curves.png"
    main([str(run), "--out", str(out)])
    assert out.read_bytes().startswith(b"\x89PNG")
    for folder, said in [
        (tmp_path / "nothing", "holds no run folder"),
        (make_run("ppo/memory-s9/lstm", 1, []), "has fewer than a hundred episodes"),
    ]:
        with pytest.raises(SystemExit):
            main([str(folder), "--out", str(tmp_path / "none.png")])
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()
