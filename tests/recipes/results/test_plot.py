"""Pictures of learning curves."""

from itertools import combinations
from pathlib import Path

import pytest
from matplotlib.image import imread

from recipes.registry import get_recipe
from recipes.results.cell import Cell
from recipes.results.plot import plot_comparison, plot_learning_curve, plot_table
from recipes.run import Run


def run_in(folder: Path) -> Run:
    return Run(folder, get_recipe("ppo/cartpole/mlp"))


def height(folder: Path, groups: int) -> int:
    """Pixels of the picture of some groups of runs."""
    metrics, picture = folder / "metrics.csv", folder / f"{groups}.png"
    metrics.write_text("step,time,return_mean\n1,0,1.0\n2,1,3.0\n")
    plot_comparison({f"run {i}": [run_in(folder)] for i in range(groups)}, picture, title="")
    return len(imread(picture))


def test_the_legend_of_many_curves_has_a_place_of_its_own(tmp_path):
    assert height(tmp_path, 1) == height(tmp_path, 2) < height(tmp_path, 3) < height(tmp_path, 9)


@pytest.mark.parametrize("length", [5, 39, 45, 90])
def test_the_legend_is_in_the_picture(length, tmp_path):
    metrics, picture = tmp_path / "metrics.csv", tmp_path / "curves.png"
    metrics.write_text("step,time,return_mean\n1,0,1.0\n2,1,3.0\n")
    runs = [run_in(tmp_path)]
    plot_comparison({f"{i} {'n' * length}": runs for i in range(4)}, picture, title="")
    shape = imread(picture)[..., :3]
    assert all(edge.min() == 1 for edge in (shape[:, 0], shape[:, -1], shape[0], shape[-1]))


def test_what_names_have_in_common_stands_in_the_title_alone(tmp_path, monkeypatch):
    metrics = tmp_path / "metrics.csv"
    metrics.write_text("step,time,return_mean\n1,0,1.0\n2,1,3.0\n")
    figures = []
    monkeypatch.setattr(
        "recipes.results.plot._write", lambda figure, picture: figures.append(figure)
    )
    names = ["ppo/cartpole/mlp", "ppo/cartpole/mlp-stack-8", "ppo/cartpole/lstm"]
    run = run_in(tmp_path)
    for title in ("", "mine"):
        plot_comparison({name: [run] for name in names}, tmp_path / "a.png", title=title)
    plot_comparison({names[0]: [run_in(tmp_path)]}, tmp_path / "a.png", title="")
    drawn = [
        (axes.get_title(), axes.get_legend_handles_labels()[1])
        for (axes,) in (figure.axes for figure in figures)
    ]
    labels = ["mlp", "mlp-stack-8", "lstm"]
    assert drawn == [("ppo/cartpole", labels), ("mine", labels), ("", [f"{names[0]}"])]


def test_what_was_changed_has_room_beside_its_panel(tmp_path, monkeypatch):
    """Names of cells overlap neither another panel nor each other, and show what was changed."""
    changes = "env ALE/Pong-v5, num_envs 2, total_steps 128, steps_per_batch 64, epochs 3"
    cells = [
        Cell("Online", f"ppo/{task}/enhanced-tit", 1, 1, 1, 0, 0, 1, 1, 1, 1, 0, changes=text)
        for task in ("a", "b", "c")
        for text in ("", changes)
    ]
    figures = []
    monkeypatch.setattr(
        "recipes.results.plot.save_figure", lambda figure, path: figures.append(figure)
    )
    plot_table(cells, tmp_path / "table.png")
    (figure,) = figures
    figure.canvas.draw()
    boxes = []
    for axes in figure.axes:
        labels = axes.get_yticklabels()
        assert [label.get_text().replace("\n", " ") for label in labels] == [
            "enhanced-tit",
            f"enhanced-tit ({changes})",
        ]
        boxes += [axes.bbox, *(label.get_window_extent() for label in labels)]
    assert not any(box.overlaps(other) for box, other in combinations(boxes, 2))


@pytest.mark.parametrize("rows", ["1,0,2.0\n", "", "1,0,nan\n"])
def test_a_run_of_one_batch_is_seen(rows, tmp_path, monkeypatch):
    metrics = tmp_path / "metrics.csv"
    metrics.write_text(f"step,time,return_mean\n{rows}")
    figures = []
    monkeypatch.setattr(
        "recipes.results.plot.save_figure", lambda figure, _: figures.append(figure)
    )
    plot_learning_curve(metrics, tmp_path / "curve.png", title="")
    (axes,) = figures[0].axes
    point = "2.0" in rows
    assert {line.get_marker() for line in axes.lines} == {"o" if point else "None"}
    assert [text.get_text() for text in axes.texts] == ([] if point else ["no episode has ended"])
    if point:
        plot_comparison({"run": [run_in(tmp_path)]}, tmp_path / "curve.png", title="")
        assert figures[1].axes[0].lines[0].get_marker() == "o"
