"""The report of runs: one HTML file, which holds all that it shows and has no scripts."""

from __future__ import annotations

import base64
import html
import io
import os
import re
import shlex
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import timedelta
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as imageio
import jinja2
import numpy as np
from matplotlib.axes import Axes

from torchrl_tit import load_agent
from torchrl_tit.agents import TrainedAgent
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.files import write_text_atomic

from ...core.numbers import measured_words, number, numbers
from ...core.recipe import Recipe
from ...core.recipe_json import recipe_to_json
from ...core.registry import RECIPES
from ...core.run import Run, package_versions
from . import comparison
from .experiments import (
    Experiment,
    changes_of,
    check_together,
    common_part,
    fields_of,
    find_runs,
    group_runs,
    read_metrics,
)
from .explanation import ExplainedStep, Explainer, explain_episode
from .film import film_policy, make_rendered
from .metric_words import MetricWords, known_columns, limit, words_of
from .plot import (
    WINDOW,
    Curve,
    add_legend,
    curve_of,
    draw_curves,
    new_chart,
    short_runs,
    to_bytes,
)
from .table import HEADER, Cell, make_table, to_columns

_OFTEN = 0.25  # minimum share of batches outside a limit for a metric to be pointed out
_ROWS = 10  # of the numbers below the learning curves
_MOST_PICTURES = 1500  # of a film: half a minute of CartPole, and a few megabytes at most
_EXPLAINED = (0, 20, 100)  # steps of an episode
_SHARP = 160  # dots per inch of explained steps


@dataclass(frozen=True)
class RunData:
    """A run, its metrics and its evaluation."""

    run: Run
    rows: list[dict[str, float]]
    evaluation: dict[str, Any] | None
    """None if it is not evaluated yet."""

    @property
    def name(self) -> str:
        """Its seed."""
        return f"seed {self.run.recipe.seed}"

    @property
    def steps(self) -> int:
        """The steps in its metrics."""
        return int(self.rows[-1]["step"])

    @property
    def seconds(self) -> float:
        """Training time without interruptions: the steps divided by their speeds."""
        speed = self.values("steps_per_second")
        done = np.diff(self.values("step"), prepend=0)
        return float((done[speed > 0] / speed[speed > 0]).sum())

    def values(self, column: str) -> np.ndarray:
        """A metric, float [rows]; NaN where it is not known."""
        return np.array([row.get(column, np.nan) for row in self.rows])


@dataclass(frozen=True)
class Group:
    """The runs of an experiment, by their seeds, and its name in the report."""

    experiment: Experiment
    label: str
    runs: list[RunData]

    @property
    def recipe(self) -> Recipe:
        """The settings of its runs, except seed and machine."""
        return self.experiment.settings


@dataclass(frozen=True)
class Chart:
    """A chart, and what it shows in words."""

    title: str
    words: MetricWords
    picture: str
    alt: str
    """For those who cannot see the chart."""
    notes: str = ""


@dataclass
class Media:
    """What agents did and looked at, and why some of it is missing."""

    films: list[dict[str, str]] = field(default_factory=list)
    explained: list[dict[str, Any]] = field(default_factory=list)
    weights: dict[str, int] = field(default_factory=dict)
    """Number of weights of a group's policy."""
    notes: list[str] = field(default_factory=list)


def report(
    folders: Iterable[Path],
    out: Path,
    *,
    title: str = "",
    pictures: bool = True,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Writes a report: results, learning curves, health, films, explanations, settings, versions.

    Args:
        folders: run folders, or folders with run folders or tables of runs somewhere below.
        out: the HTML file to write.
        title: its title; by default what the names of the runs' recipes have in common.
        pictures: whether to film and explain the agents, which takes most of the time.
        say: called with a line before each slow part.

    Raises:
        OSError: if the file cannot be written, or a checkpoint is damaged.
        ValueError: if a folder holds no run, a run is damaged, or runs cannot be compared.
    """
    _check_out(out)
    groups, notes = read_groups(folders)
    cells: list[Cell] = []
    for group in groups:
        try:
            found, texts = make_table([data.run.folder for data in group.runs])
            one = group.experiment
            found = [replace(cell, recipe=one.name, changes=one.changes) for cell in found]
        except ValueError as error:  # none of the runs is trained and evaluated
            found = []
            texts = _held_out(group) or [f"{group.label} has no results: {error}"]
        cells += found
        notes += texts
    media = _make_media(groups, say) if pictures else Media()
    write_text_atomic(out, _render(_context(groups, cells, notes, media, title)))


def read_groups(folders: Iterable[Path]) -> tuple[list[Group], list[str]]:
    """Reads runs and groups those of the same settings.

    Args:
        folders: as for :func:`report`.

    Returns:
        The groups, and the notes of :func:`check_together`.

    Raises:
        ValueError: if a folder holds no run, a run is damaged or has no metrics, two runs are the
            same, or runs have different tasks or different kinds of steps.
    """
    experiments = group_runs(find_runs(folders))
    notes = check_together(experiments)
    common = common_part([experiment.name for experiment in experiments])
    groups = [
        Group(
            experiment,
            experiment.label.removeprefix(common),
            [_read(run) for run in sorted(experiment.runs, key=lambda run: run.recipe.seed)],
        )
        for experiment in experiments
    ]
    return groups, notes


def _check_out(out: Path) -> None:
    """Raises an error early if the file could not be written at the end."""
    if out.suffix not in (".html", ".htm"):
        raise ValueError(f"a report is an .html file, not {out.name!r}")
    if out.is_dir():
        raise IsADirectoryError(f"{out} cannot be written: it is a folder")
    folder = out.absolute().parent
    if not folder.is_dir():
        raise FileNotFoundError(f"{out} cannot be written: there is no folder {out.parent}")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{out} cannot be written: {out.parent} may not be written to")


def _read(run: Run) -> RunData:
    rows = read_metrics(run)
    if not rows:
        raise ValueError(
            f"{run.folder} has no metrics yet: train it first, for more steps than its "
            "log_interval, or leave it out of the report"
        )
    if "return_mean" not in rows[0]:
        raise ValueError(f"{run.folder / 'metrics.csv'} is damaged: it has no column return_mean")
    evaluation = run.read_evaluation()
    if evaluation is not None and (
        "returns" not in evaluation  # nothing was played
        or evaluation["steps"] < rows[-1]["step"]  # by earlier weights
    ):
        evaluation = None
    return RunData(run, rows, evaluation)


def _held_out(group: Group) -> list[str]:
    """What was measured on the held-out episodes of runs without an environment."""
    found = [(data, data.run.read_evaluation()) for data in group.runs]
    return [
        f"{group.label}, {data.name}, on {evaluation['held_out_episodes']} held-out episodes: "
        f"{measured_words(evaluation)}"
        for data, evaluation in found
        if evaluation is not None and "held_out" in evaluation
    ]


def _make_media(groups: Sequence[Group], say: Callable[[str], None]) -> Media:
    """Films and explains the agent of a run of each group: the one in the middle."""
    media = Media()
    for group in groups:
        can_act = [one for one in group.runs if checkpoint_steps(one.run.checkpoints)]
        if not can_act:
            media.notes.append(f"No film of {group.label}: there is no checkpoint.")
            continue
        evaluated = [(one.evaluation["mean"], i) for i, one in enumerate(can_act) if one.evaluation]
        middle = sorted(evaluated)[(len(evaluated) - 1) // 2][1] if evaluated else 0
        run = can_act[middle].run
        say(f"filming and explaining {run.folder}")
        try:
            agent = load_agent(run.folder)
            media.weights[group.label] = sum(p.numel() for p in agent.policy.parameters())
            media.films.append(_film(group, run, agent))
            steps = _explain(agent, _EXPLAINED[: 3 if len(groups) == 1 else 2])
            media.explained.append({"label": group.label, "steps": steps})
        except (ValueError, ImportError) as error:  # it cannot be rendered, or has no maps
            media.notes.append(f"Not everything of {group.label} is shown: {error}")
    return media


def _film(group: Group, run: Run, agent: TrainedAgent) -> dict[str, str]:
    seed = agent.first_seed
    with TemporaryDirectory() as folder:
        video = Path(folder, "episode.mp4")
        (played,) = film_policy(
            agent.make_env, agent.policy, agent.name, video, 1, seed, _MOST_PICTURES
        )
        content = _data("video/mp4", video.read_bytes())
    several = f"{run.folder.name}, in the middle by its evaluation, " if group.runs[1:] else ""
    caption = f"{group.label}, {several}episode of seed {seed}: return {number(played)}."
    return {"video": content, "caption": caption, "alt": f"Film of {run.recipe.env}. {caption}"}


def _explain(agent: TrainedAgent, steps: Sequence[int]) -> list[dict[str, Any]]:
    found = []

    def show(number: int, step: ExplainedStep, page: np.ndarray) -> None:
        buffer = io.BytesIO()
        imageio.imwrite(buffer, page, extension=".png")
        alt = f"Step {number}. {step.describe()}"
        picture = _data("image/png", buffer.getvalue())
        found.append({"number": number, "picture": picture, "alt": alt})

    explainer = Explainer(agent.policy)
    with closing(make_rendered(agent.make_env, agent.name)) as env:
        options: dict[str, Any] = {"title": "", "seed": agent.first_seed, "dpi": _SHARP}
        explain_episode(env, explainer, agent.name, steps, show, **options)
    return found


def _context(
    groups: Sequence[Group], cells: Sequence[Cell], notes: list[str], media: Media, title: str
) -> dict[str, Any]:
    """What the page's template reads."""
    recipe = groups[0].recipe
    runs = [(group, data) for group in groups for data in group.runs]
    columns = _columns(groups)
    returns = [column for column in columns if "return" in column]
    returns = returns or [column for column in columns if column.startswith("held_out_")][:1]
    same = _constants(groups, [column for column in columns if column not in returns])
    order = {column: place for place, column in enumerate(known_columns(recipe.algorithm))}
    health = sorted({*columns} - {*returns} - {*same}, key=lambda one: order.get(one, len(order)))
    curves = [_chart(groups, column) for column in returns]
    common = common_part([group.experiment.name for group in groups]).rstrip("/")
    name = recipe.name if len(groups) == 1 else common if "/" in common else recipe.env
    left_out = [  # by bold lines
        line
        for group in groups
        for line in short_runs(group.label, {data.name: data.steps for data in group.runs})
    ]
    return {
        "title": title or name or groups[0].label,
        "description": _description(groups),
        "version": package_versions()["torchrl-tit"],
        "date": time.strftime("%Y-%m-%d"),
        "unit": _unit(recipe),
        "notes": notes + left_out,
        "header": HEADER,
        "cells": [(to_columns(cell), cell.published) for cell in cells],
        "compared_header": comparison.HEADER,
        "compared_words": comparison.WORDS,
        "compared": comparison.compare_with_first([(x.label, x.values) for x in cells]),
        "returns": [chart for chart, _ in curves],
        "numbers": _numbers(curves[0][1]) if curves else [],
        "labels": [group.label for group in groups],
        "health": [_chart(groups, column)[0] for column in health],
        "constants": [f"{column} {number(value)}" for column, value in same.items()],
        "findings": _findings(groups, columns),
        "checked": [column for column in columns if _limits(recipe, column)],
        "media": media,
        "groups": [_settings(index, groups, media) for index in range(len(groups))],
        "between": _differences(groups),
        "runs": [_run(group, data) for group, data in runs],
        "versions": _versions([data for _, data in runs]),
    }


def _columns(groups: Sequence[Group]) -> list[str]:
    """The metrics that are known at some step of some run, in the order of the files."""
    names = dict.fromkeys(name for group in groups for one in group.runs for name in one.rows[0])
    return [
        name
        for name in names
        if name not in ("step", "time")
        and any(np.isfinite(one.values(name)).any() for group in groups for one in group.runs)
    ]


def _constants(groups: Sequence[Group], columns: Iterable[str]) -> dict[str, float]:
    """The metrics that have one and the same value wherever runs measured them, more than once."""
    found = {}
    for column in columns:
        values = np.concatenate([one.values(column) for group in groups for one in group.runs])
        values = values[np.isfinite(values)]
        if len(values) > 1 and (values == values[0]).all():
            found[column] = float(values[0])
    return found


def _chart(groups: Sequence[Group], column: str) -> tuple[Chart, dict[str, Curve]]:
    """A chart of a metric, and its bold lines."""
    recipe = groups[0].recipe
    words = words_of(recipe.algorithm, column)
    figure, axes = new_chart("", recipe)
    axes.set_ylabel("")
    curves = {group.label: [curve_of(one.rows, column) for one in group.runs] for group in groups}
    of_batches = column == "return_mean" and not recipe.offline
    bold = draw_curves(axes, curves, WINDOW if of_batches else 1)
    if len(groups) > 1:
        add_legend(figure)
    notes = "Bold lines are moving averages. " if of_batches else ""
    values = np.concatenate([curve.values for runs in curves.values() for curve in runs])
    if _cut(axes, values):
        notes += "A few extreme values lie outside the axis. "
    limits = _limits(recipe, column)
    low, high = axes.get_ylim()
    for bound, _ in limits if all(_limits(g.recipe, column) == limits for g in groups) else ():
        if low <= bound <= high:
            axes.axhline(bound, c="0.4", lw=1, ls="--", zorder=0)
            notes += "The dashed line is the healthy limit. "
    texts = [
        f"{label}: {number(x.values[0])} at step {x.steps[0]:,.0f}, highest "
        f"{number(x.values.max())}, {number(x.values[-1])} at step {x.steps[-1]:,.0f}"
        for label, x in bold.items()
    ]
    alt = f"Line chart of {column} over {_unit(recipe)}. {'. '.join(texts)}."
    return Chart(column, words, _data("image/svg+xml", to_bytes(figure, "svg")), alt, notes), bold


def _cut(axes: Axes, values: np.ndarray) -> bool:
    """Leaves extreme values out of the axis if they would flatten the others to a line."""
    low, high = np.percentile(values, [2, 98])
    if high <= low or values.max() - values.min() <= 4 * (high - low):
        return False
    axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    return True


def _numbers(bold: dict[str, Curve]) -> list[list[str]]:
    """The values of bold lines at a few steps."""
    last = max(curve.steps[-1] for curve in bold.values())
    return [
        [
            f"{step:,.0f}",
            *(
                number(float(np.interp(step, curve.steps, curve.values, np.nan, np.nan)))
                for curve in bold.values()
            ),
        ]
        for step in np.linspace(0, last, _ROWS + 1)[1:]
    ]


def _limits(recipe: Recipe, column: str) -> list[tuple[float, int]]:
    """The limits of a metric's healthy range: -1 for one that it should not fall below, or 1."""
    words = words_of(recipe.algorithm, column)
    found = [(limit(words.low, recipe), -1), (limit(words.high, recipe), 1)]
    return [(bound, sign) for bound, sign in found if bound is not None]


def _findings(groups: Sequence[Group], columns: Iterable[str]) -> list[tuple[MetricWords, str]]:
    """Lists metrics that were outside their healthy range in a quarter of the batches or more."""
    found: dict[MetricWords, list[str]] = {}
    for column in columns:
        for group in groups:
            words = words_of(group.recipe.algorithm, column)
            for bound, sign in _limits(group.recipe, column):
                share = np.mean([_share_outside(one, words, bound, sign) for one in group.runs])
                if share >= _OFTEN:
                    side = "above" if sign > 0 else "below"
                    of = f" of {group.label}" if groups[1:] else ""
                    text = f"was {side} {number(bound)} in {share:.0%} of the batches{of}"
                    found.setdefault(words, []).append(text)
    return [(words, ", ".join(texts)) for words, texts in found.items()]


def _share_outside(data: RunData, words: MetricWords, bound: float, sign: int) -> float:
    """The share of the rows with a metric in which it is beyond a limit."""
    values = data.values(words.column)
    outside = sign * (values - bound) > 0
    if words.needs in data.rows[0]:  # without changes of that one, it says nothing
        needed = data.values(words.needs)
        known = np.maximum.accumulate(np.isfinite(needed) * np.arange(len(needed)))
        outside &= np.diff(needed[known], prepend=np.nan) != 0
    return float(outside.sum() / max(1, np.isfinite(values).sum()))


def _description(groups: Sequence[Group]) -> str:
    algorithms = dict.fromkeys(group.recipe.algorithm.upper() for group in groups)
    runs = sum(len(group.runs) for group in groups)
    steps = [data.steps for group in groups for data in group.runs]
    length = " to ".join(f"{x:,}" for x in dict.fromkeys((min(steps), max(steps))))
    many = f"{len(groups)} experiments, " if len(groups) > 1 else ""
    return (
        f"{groups[0].recipe.task_name}, {' and '.join(algorithms)}: {many}{runs} "
        f"run{'s' * (runs > 1)} of {length} {_unit(groups[0].recipe)}{' each' * (runs > 1)}"
    )


def _settings(index: int, groups: Sequence[Group], media: Media) -> dict[str, Any]:
    """The settings of a group, how they differ from the recipe of that name, and the command."""
    group = groups[index]
    recipe = group.recipe
    named = RECIPES.get(recipe.name)
    old = fields_of(named) if named else {}
    changes = changes_of(named, recipe) if named else {}
    file = "recipe.json" if len(groups) == 1 else f"recipe-{index + 1}.json"
    source = shlex.quote(recipe.name if named and not changes else file)
    seeds = " ".join(str(data.run.recipe.seed) for data in group.runs)
    command = f"sweep {source} --seeds" if group.runs[1:] else f"train {source} --seed"
    return {
        "label": group.label,
        "name": recipe.name if named else "",
        "backbone": recipe.backbone,
        "weights": media.weights.get(group.label),
        "changes": [(name, _text(old.get(name, "-")), _text(x)) for name, x in changes.items()],
        "settings": {name: _text(value) for name, value in fields_of(recipe).items()},
        "command": f"torchrl-tit {command} {seeds}",
        "file": file,
        "content": _data("application/json", recipe_to_json(recipe).encode()),
    }


def _differences(groups: Sequence[Group]) -> list[list[str]]:
    """The fields that all experiments have and in which they differ: the field, and its values."""
    settings = [fields_of(group.recipe) for group in groups]
    shared = [name for name in settings[0] if all(name in one for one in settings)]
    rows = [[name, *(_text(one[name]) for one in settings)] for name in shared if name != "name"]
    return [row for row in rows if len({*row[1:]}) > 1]


def _run(group: Group, data: RunData) -> list[str]:
    """The cells of a run's row."""
    evaluation, seconds = data.evaluation, data.seconds
    return [
        "/".join(data.run.folder.absolute().parts[-3:]),
        group.label,
        str(data.run.recipe.seed),
        f"{data.steps:,}",
        " ± ".join(numbers([evaluation["mean"], evaluation["std"]])) if evaluation else "-",
        str(evaluation["episodes"]) if evaluation else "-",
        str(timedelta(seconds=round(seconds))) if seconds else "-",
        f"{data.steps / seconds:,.0f}" if seconds else "-",
    ]


def _versions(runs: Sequence[RunData]) -> list[tuple[str, str]]:
    """The runs of each set of versions, and these versions."""
    found: dict[str, list[str]] = {}
    for data in runs:
        text = ", ".join(f"{name} {version}" for name, version in data.run.versions().items())
        found.setdefault(text or "not known", []).append(data.run.folder.name)
    return [("all runs" if len(found) == 1 else ", ".join(x), text) for text, x in found.items()]


def _unit(recipe: Recipe) -> str:
    return "gradient steps" if recipe.offline else "environment steps"


def _text(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _render(context: dict[str, Any]) -> str:
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"sentence": _sentence}
    page = resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8")
    return environment.from_string(page).render(context)


def _sentence(text: str) -> str:
    """Escapes sentences, and formats what is between backticks as code."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))
