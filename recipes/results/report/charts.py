"""The charts of a report: curves over the steps, and the returns of evaluation episodes."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go

from ..interval import intervals_of
from ..metric_words import MetricWords, known_columns, limit, words_of
from .run_data import Group, RunData

COLOURS = (
    "#0b57c2",
    "#b8400a",
    "#00754a",
    "#8a35a6",
    "#7a5c00",
    "#b3175e",
    "#3d4d57",
    "#007482",
)
"""Each has a contrast of at least 4.5 to 1 on white, and colour-blind readers can tell neighbours
apart."""
FAR = 0.9
"""Minimum length of a run, as a share of the longest, to be included in bold lines."""
DASHES = ("solid", "dash", "dot", "dashdot")
_POINTS = 400  # per curve; if there are more rows, neighbours are averaged
_GRID = 200  # points at which runs with different rows are compared
_WINDOW = 5  # batches over which bold returns are averaged
_ROWS_TO_SMOOTH = 40
_MOST_HOVERED = 9
_MOST_BOXES = 12
_INK, _LINES = "#1c2733", "#e3e8ed"


@dataclass(frozen=True)
class Chart:
    """A chart and its description in words."""

    column: str
    title: str
    words: MetricWords
    figure: str
    """The figure for Plotly, as JSON."""
    alt: str
    """A text alternative for those who cannot see the chart."""
    can_be_log: bool
    """Whether all values are above 0."""
    is_cut: bool
    """Whether the axis initially leaves out extreme values."""
    has_limit: bool
    """Whether a dashed line shows a healthy limit."""


def style(index: int) -> tuple[str, str]:
    """Colour and dash of a group's lines."""
    return COLOURS[index % len(COLOURS)], DASHES[index // len(COLOURS) % len(DASHES)]


def return_charts(groups: Sequence[Group]) -> list[Chart]:
    """Charts of the returns: those of training, and those of evaluations if there are any."""
    columns = [c for c in _columns(groups) if "return" in c and _is_curve(groups, c)]
    return [_chart(groups, column) for column in columns]


def health_charts(groups: Sequence[Group]) -> list[Chart]:
    """Charts of all other metrics except constant ones, the most informative first."""
    order = known_columns(groups[0].recipe.algorithm)
    columns = [c for c in _columns(groups) if "return" not in c and c not in constants(groups)]
    known = [column for column in order if column in columns]
    return [_chart(groups, c) for c in dict.fromkeys([*known, *columns])]


def constants(groups: Sequence[Group]) -> dict[str, float]:
    """The metrics that have the same value in all rows of all runs, except returns."""
    found = {}
    for column in _columns(groups):
        values = np.concatenate([run.metrics.get(column, []) for g in groups for run in g.runs])
        values = values[np.isfinite(values)]
        if "return" not in column and (values == values[0]).all():
            found[column] = float(values[0])
    return found


def episode_chart(groups: Sequence[Group]) -> Chart | None:
    """A chart of the returns of all evaluation episodes; None if all are equal."""
    figure = go.Figure()
    words, seen = [], []
    evaluated = [(g, r) for g, group in enumerate(groups) for r in group.runs if r.evaluation]
    together = len(evaluated) > _MOST_BOXES  # a box for each group
    for index, group in enumerate(groups):
        members = [run for g, run in evaluated if g == index]
        boxes = [members] if together and members else [[run] for run in members]
        for runs in boxes:
            returns = np.concatenate([_returns(run) for run in runs])
            seen.append(returns)
            name = group.label if together else _run_name(groups, group, runs[0])
            place: Any = [name if together else runs[0].label] * len(returns)
            if len(groups) > 1 and not together:
                place = [[group.label] * len(returns), place]
            meta: dict[str, Any] = {"group": index, "kind": "episodes"}
            if not together:
                meta["run"] = group.runs.index(runs[0])
            _add_box(figure, index, name, place, returns, meta, points=not together)
            low, middle, high = np.percentile(returns, [25, 50, 75])
            words.append(
                f"{name}: median {_number(middle)}, half of them from {_number(low)} to "
                f"{_number(high)}"
            )
    flat = np.concatenate(seen) if seen else np.array([])
    if len(np.unique(flat)) < 2:
        return None
    _lay_out(figure, "", "return of an episode")
    pairs = len(groups) > 1 and not together
    figure.update_xaxes(type="multicategory" if pairs else "category", title=None)
    figure.update_layout(hovermode="closest")
    what = "one point for each episode; boxes hold half of them, dashed lines are means"
    if together:
        what = "episodes of all runs together; boxes hold half of them, dashed lines are means"
    return Chart(
        "evaluation-episodes",
        "Evaluation episodes",
        MetricWords("", what),
        _json(figure),
        f"Box plot of the returns of evaluation episodes. {'. '.join(words)}.",
        can_be_log=bool((flat > 0).all()),
        is_cut=False,
        has_limit=False,
    )


def _returns(run: RunData) -> np.ndarray:
    assert run.evaluation is not None
    return np.array(run.evaluation["returns"])


def _add_box(
    figure: go.Figure,
    index: int,
    name: str,
    place: list[Any],
    returns: np.ndarray,
    meta: dict[str, Any],
    *,
    points: bool,
) -> None:
    colour, _ = style(index)
    figure.add_box(
        x=place,
        y=returns,
        name=name,
        boxpoints="all" if points else "outliers",
        jitter=0.6,
        pointpos=0,
        marker={"color": colour, "size": 4, "opacity": 0.45},
        line={"color": colour, "width": 1.5},
        fillcolor="rgba(0,0,0,0)",
        boxmean=True,
        hoveron="points",
        hovertemplate=f"{html.escape(name)}<br>return %{{y:,.5g}}<extra></extra>",
        meta=meta,
    )


def last_value(run: RunData, column: str) -> float:
    """The mean of a metric over the last tenth of a run's rows; NaN if it is unknown there."""
    values = run.metrics.get(column, np.array([np.nan]))
    tail = values[-max(1, len(values) // 10) :]
    known = tail[np.isfinite(tail)]
    return float(known.mean()) if len(known) else float("nan")


def _columns(groups: Sequence[Group]) -> list[str]:
    """The metrics of all groups, in the order of their first mention."""
    return list(dict.fromkeys(column for group in groups for column in group.columns))


def _is_curve(groups: Sequence[Group], column: str) -> bool:
    """Whether any run has more than one value, or there is nothing else to show of training."""
    counts = [
        np.isfinite(run.metrics[column]).sum()
        for group in groups
        for run in group.runs
        if column in run.metrics
    ]
    evaluated = any(run.evaluation for group in groups for run in group.runs)
    return max(counts) > 1 or (column == "return_mean" and not evaluated)


def _chart(groups: Sequence[Group], column: str) -> Chart:
    is_return = "return" in column
    figure = go.Figure()
    words, seen = [], []
    hovered = sum(1 + len(group.runs) for group in groups) <= _MOST_HOVERED
    for index, group in enumerate(groups):
        curves = [_curve(run, column) for run in group.runs]
        for number, (steps, values) in enumerate(curves):
            if not len(steps):
                continue
            alone = len(curves) == 1
            smooth = is_return and len(steps) > _ROWS_TO_SMOOTH
            _add_run(figure, groups, index, number, steps, values, alone and not smooth, hovered)
            seen.append(values)
        longest = max(run.steps for run in group.runs)
        known = [
            curve
            for run, curve in zip(group.runs, curves, strict=True)
            if len(curve[0]) and run.steps >= FAR * longest
        ]
        if not known:
            continue
        steps, mean = _add_middle(figure, groups, index, known, is_return)
        highest = int(mean.argmax())
        words.append(
            f"{group.label}: {_number(mean[0])} at step {steps[0]:,.0f}, highest "
            f"{_number(mean[highest])} at step {steps[highest]:,.0f}, {_number(mean[-1])} at step "
            f"{steps[-1]:,.0f}"
        )
    recipe = groups[0].recipe
    described = words_of(recipe.algorithm, column)
    unit = "gradient steps" if recipe.offline else "environment steps"
    _lay_out(figure, unit, "return" if is_return else "")
    everything = np.concatenate(seen)
    is_cut = _cut(figure, everything)
    limits = [] if is_return else _draw_limits(figure, groups, described)
    ends = figure.layout.yaxis.range or (-np.inf, np.inf)
    title = _return_title(column, offline=recipe.offline) if is_return else column
    return Chart(
        column,
        title,
        described,
        _json(figure),
        f"Line chart of {column} over {unit}. {'. '.join(words)}.",
        can_be_log=bool((everything > 0).all() and everything.max() > everything.min()),
        is_cut=is_cut,
        has_limit=any(ends[0] <= bound <= ends[1] for bound in limits),
    )


def _return_title(column: str, *, offline: bool) -> str:
    if column == "return_mean":
        return "Return of evaluations" if offline else "Return of training episodes"
    if column == "evaluation_return":
        return "Return of evaluations during training"
    if column == "online_return":
        return "Return of the episodes played for training"
    return f"Return of evaluations that aim for {column.removeprefix('return_')}"


def _add_run(
    figure: go.Figure,
    groups: Sequence[Group],
    index: int,
    number: int,
    steps: np.ndarray,
    values: np.ndarray,
    is_main: bool,
    hovered: bool,
) -> None:
    colour, dash = style(index)
    name = html.escape(_run_name(groups, groups[index], groups[index].runs[number]))
    figure.add_scatter(
        x=steps,
        y=values,
        mode="lines+markers" if len(steps) < 2 else "lines",
        name=name,
        line={"color": colour, "width": 2.2 if is_main else 1, "dash": dash},
        opacity=1 if is_main else 0.38,
        hoverinfo=None if hovered or is_main else "skip",
        hovertemplate=f"{name}: %{{y:,.4g}}<extra></extra>" if hovered or is_main else None,
        meta={"group": index, "run": number, "kind": "middle" if is_main else "run"},
    )


def _add_middle(
    figure: go.Figure,
    groups: Sequence[Group],
    index: int,
    curves: list[tuple[np.ndarray, np.ndarray]],
    is_return: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Draws the summary of a group's runs; returns its steps and values."""
    group = groups[index]
    colour, dash = style(index)
    if is_return:
        curves = [(steps, _smoothed(values)) for steps, values in curves]
    steps, values = _on_one_grid(curves)
    middle, low, high = intervals_of(values)
    name = html.escape(group.label)
    meta = {"group": index, "kind": "middle"}
    if len(curves) > 1:
        band = {"mode": "lines", "line": {"width": 0, "color": colour}, "hoverinfo": "skip"}
        figure.add_scatter(x=steps, y=low, **band, meta={**meta, "kind": "band"})
        figure.add_scatter(
            x=steps,
            y=high,
            **band,
            fill="tonexty",
            fillcolor=_transparent(colour),
            meta={**meta, "kind": "band"},
        )
        described = f"{name}, {len(curves)} runs: %{{y:,.4g}}"
        hover = f"{described} [%{{customdata[0]:,.4g}}, %{{customdata[1]:,.4g}}]<extra></extra>"
        ends = np.stack([low, high], -1)
    elif is_return and len(steps) > _ROWS_TO_SMOOTH:
        hover, ends = f"{name}, mean of {_WINDOW}: %{{y:,.4g}}<extra></extra>", None
    else:  # the run itself is drawn already
        return steps, middle
    figure.add_scatter(
        x=steps,
        y=middle,
        mode="lines",
        name=name,
        line={"color": colour, "width": 2.6, "dash": dash},
        customdata=ends,
        hovertemplate=hover,
        meta=meta,
    )
    return steps, middle


def _curve(run: RunData, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of a metric, where it is known, thinned out by averaging."""
    values = run.metrics.get(column)
    if values is None:
        return np.array([]), np.array([])
    known = np.isfinite(values)
    steps, values = run.metrics["step"][known], values[known]
    size = -(-len(steps) // _POINTS)
    if size < 2:
        return steps, values
    starts = np.arange(0, len(steps), size)
    counts = np.diff(starts, append=len(steps))
    ends = np.minimum(starts + size, len(steps)) - 1
    return steps[ends], np.add.reduceat(values, starts) / counts


def _smoothed(values: np.ndarray) -> np.ndarray:
    if len(values) <= _ROWS_TO_SMOOTH:
        return values
    return np.array([values[max(0, i - _WINDOW + 1) : i + 1].mean() for i in range(len(values))])


def _on_one_grid(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """The steps that curves have in common, and their values there, [curves, steps]."""
    first = curves[0][0]
    if all(np.array_equal(steps, first) for steps, _ in curves):
        return first, np.stack([values for _, values in curves])
    start = max(steps[0] for steps, _ in curves)
    end = max(start, min(steps[-1] for steps, _ in curves))
    grid = np.linspace(start, end, _GRID)
    return grid, np.stack([np.interp(grid, *curve) for curve in curves])


def _draw_limits(figure: go.Figure, groups: Sequence[Group], words: MetricWords) -> list[float]:
    """Draws a dashed line at each limit that all groups share; returns these limits."""
    drawn = []
    for formula in (words.low, words.high):
        limits = {limit(formula, group.recipe) for group in groups}
        if len(limits) == 1 and (value := limits.pop()) is not None:
            line = {"color": "#5b6770", "width": 1.2, "dash": "6px,4px"}
            figure.add_shape(
                type="line", xref="paper", x0=0, x1=1, y0=value, y1=value, line=line, layer="below"
            )
            drawn.append(value)
    return drawn


def _cut(figure: go.Figure, values: np.ndarray) -> bool:
    """Leaves extreme values out of the axis if they would flatten the others to a line."""
    low, high = np.percentile(values, [2, 98])
    if high <= low or values.max() - values.min() <= 4 * (high - low):
        return False
    figure.update_yaxes(range=[low - 0.1 * (high - low), high + 0.1 * (high - low)])
    return True


def _lay_out(figure: go.Figure, x_title: str, y_title: str) -> None:
    figure.update_layout(
        template="none",
        autosize=True,
        showlegend=False,
        hovermode="x unified",
        dragmode="zoom",
        margin={"l": 62 if y_title else 46, "r": 14, "t": 14, "b": 46 if x_title else 30},
        paper_bgcolor="#ffffff",
        plot_bgcolor="#ffffff",
        font={"family": "system-ui, -apple-system, Segoe UI, sans-serif", "size": 13},
        font_color=_INK,
        hoverlabel={"bgcolor": "#ffffff", "bordercolor": "#9aa7b2", "namelength": -1},
    )
    axis = {
        "gridcolor": _LINES,
        "linecolor": "#7d8a96",
        "zeroline": False,
        "automargin": True,
        "exponentformat": "SI",
        "minexponent": 4,
    }
    figure.update_xaxes(**axis, title={"text": x_title, "standoff": 8}, hoverformat=",.0f")
    figure.update_yaxes(**axis, title={"text": y_title, "standoff": 6})


def _run_name(groups: Sequence[Group], group: Group, run: RunData) -> str:
    if len(groups) == 1:
        return run.label
    return group.label if len(group.runs) == 1 else f"{group.label}, {run.label}"


def _transparent(colour: str) -> str:
    red, green, blue = (int(part, 16) for part in re.findall("..", colour[1:]))
    return f"rgba({red},{green},{blue},0.16)"


def _number(value: float) -> str:
    return f"{value:,.4g}" if abs(value) < 10_000 else f"{value:,.0f}"


def _json(figure: go.Figure) -> str:
    return str(figure.to_json(remove_uids=True))
