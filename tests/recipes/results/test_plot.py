"""Pictures of learning curves and tables."""

import numpy as np
import pytest

from recipes.core.run import Run
from recipes.tools.results import plot, table
from recipes.tools.results.experiments import Experiment
from recipes.tools.results.plot import (
    Curve,
    curve_of,
    draw_curves,
    new_chart,
    plot_comparison,
    plot_run,
)
from tests.recipes.results.report_runs import write_run
from tests.recipes.small import TINY

TWO = {"step": [1, 2], "time": [0, 1], "return_mean": [1.0, 3.0]}


def experiments_of(folder, *names):
    run = Run.open(write_run(folder, "ppo/cartpole/mlp", metrics=TWO))
    return [Experiment(run.recipe, name, "", (run,)) for name in names]


@pytest.fixture
def figures(monkeypatch):
    """Figures instead of files."""
    found = []
    for module in (plot, table):
        monkeypatch.setattr(module, "save_figure", lambda figure, picture: found.append(figure))
    return found


def test_what_names_have_in_common_stands_in_the_title_alone(tmp_path, figures):
    names = ["ppo/cartpole/mlp", "ppo/cartpole/$5", "ppo/cartpole/lstm"]
    runs = experiments_of(tmp_path / "run", *names)
    for title in ("", "mine"):
        plot_comparison(runs, tmp_path / "a.png", title=title)
    drawn = [(f.axes[0].get_title(), f.axes[0].get_legend_handles_labels()[1]) for f in figures]
    labels = ["mlp", r"\$5", "lstm"]
    assert drawn == [("ppo/cartpole", labels), ("mine", labels)]


def test_bold_lines_are_interquartile_means_of_runs_that_are_as_far():
    steps = np.arange(1.0, 11)
    runs = [Curve(steps, steps * factor) for factor in (1.0, 2.0, 3.0, 4.0, 30.0)]
    _, axes = new_chart("", TINY)
    bold = draw_curves(axes, {"a": [*runs, Curve(steps[:8], steps[:8])], "none": []})
    assert bold.keys() == {"a"}
    assert np.allclose(bold["a"].values, 3 * steps)
    labels = [line.get_label() for line in axes.lines]
    assert len(labels) == 7  # of single runs, and the bold one
    assert labels[-1] == "a (5 runs)"
    band = np.asarray(axes.collections[0].get_paths()[0].vertices)
    assert band[:, 1].max() <= 300
    _, axes = new_chart("", TINY)
    bold = draw_curves(axes, {"a": runs[:4]})
    assert np.allclose(bold["a"].values, 2.5 * steps)
    assert not axes.collections  # too few for a band


def test_runs_without_an_end_of_an_episode_are_as_far_as_their_steps():
    """The best run of a task in which episodes become longer is the last to end one."""
    rows = [{"step": step, "return_mean": 5.0} for step in range(1, 11)]
    best = [row if row["step"] < 7 else row | {"return_mean": np.nan} for row in rows]
    _, axes = new_chart("", TINY)
    bold = draw_curves(axes, {"a": [curve_of(rows), curve_of(best)]})["a"]
    assert axes.lines[-1].get_label() == "a (2 runs)"
    assert (bold.steps[0], bold.steps[-1]) == (1, 6)


def test_runs_with_other_steps_are_interpolated_and_returns_averaged():
    _, axes = new_chart("", TINY)
    runs = [Curve(np.array([0.0, 10]), np.array([0.0, 10])), Curve(np.array([2.0, 9]), np.ones(2))]
    bold = draw_curves(axes, {"a": runs})["a"]
    assert (bold.steps[0], bold.steps[-1]) == (2, 9)
    assert np.allclose(bold.values, (bold.steps + 1) / 2)
    values = np.arange(8.0)
    bold = draw_curves(axes, {"a": [Curve(values, values)]}, window=5)["a"]
    assert np.allclose(bold.values, [0, 0.5, 1, 1.5, 2, 3, 4, 5])


def test_long_curves_are_thinned_by_means_of_neighbors():
    rows = [{"step": step, "return_mean": step % 3} for step in range(1, 1201)]
    curve = curve_of([*rows, {"step": 1201, "return_mean": np.nan}, {"step": 1202}])
    assert np.allclose(curve.values, 1)
    assert (len(curve.steps), curve.steps[-1]) == (400, 1200)


@pytest.mark.parametrize("values", [[2.0], [], [np.nan]])
def test_a_run_of_one_batch_is_seen(values, tmp_path, figures):
    metrics = {"step": [1] * len(values), "return_mean": values}
    plot_run(Run.open(write_run(tmp_path / "run", "ppo/cartpole/mlp", metrics=metrics)))
    (axes,) = figures[0].axes
    point = values == [2.0]
    assert [line.get_marker() for line in axes.lines[-1:]] == ["o"] * point
    assert [text.get_text() for text in axes.texts] == ["no episode has ended"] * (not point)


def test_without_an_environment_the_error_on_held_out_episodes_is_drawn(tmp_path, figures):
    metrics = {"step": [1, 2], "return_mean": [np.nan] * 2, "held_out_action_error": [0.5, 0.25]}
    plot_run(Run.open(write_run(tmp_path / "run", "bc/mlp", metrics=metrics)))
    (axes,) = figures[0].axes
    assert axes.get_ylabel() == "error on held-out episodes"
    assert [*axes.lines[-1].get_ydata()] == [0.5, 0.25]
