"""Writes the page of a report."""

from __future__ import annotations

import base64
import html
import json
import re
import shlex
import time
from collections.abc import Sequence
from importlib import resources
from itertools import takewhile
from typing import Any

import jinja2
import numpy as np
from plotly.offline import get_plotlyjs

from ...recipe_json import recipe_to_json
from ...run import package_versions
from ..cell import Cell
from . import facts
from .charts import FAR, Chart, constants, episode_chart, health_charts, return_charts, style
from .facts import duration, number, spread
from .media import Explained, Film, Media
from .run_data import Group, RunData

_MOST_SINGLE = 9  # maximum number of runs whose single curves are initially shown
_ROWS = 11


def write_page(
    groups: Sequence[Group],
    cells: Sequence[tuple[Cell | None, list[str]]],
    media: Media,
    title: str,
) -> str:
    """Writes the page as HTML.

    Args:
        groups: the experiments.
        cells: the row of the table of results for each, and notes on it.
        media: their films and explanations.
        title: the page's title; by default what the names of the recipes have in common.
    """
    return _render(_context(groups, cells, media, title))


def _context(
    groups: Sequence[Group],
    cells: Sequence[tuple[Cell | None, list[str]]],
    media: Media,
    title: str,
) -> dict[str, Any]:
    recipe = groups[0].recipe
    runs = [(group, data) for group in groups for data in group.runs]
    curves, health = return_charts(groups), health_charts(groups)
    episodes = episode_chart(groups)
    drawn = [*curves, *health, *([episodes] if episodes else [])]
    known = [cell for cell, _ in cells if cell is not None]
    has_paper = any(cell.paper_mean == cell.paper_mean for cell in known)
    is_score = any("score" in (data.evaluation or {}) for _, data in runs)
    measure = "normalised score" if is_score else "return of the evaluation"
    return {
        "title": title or _title(groups),
        "description": _description(groups, recipe.env, recipe.algorithm),
        "sections": _sections(media),
        "version": package_versions()["torchrl-tit"],
        "date": time.strftime("%Y-%m-%d"),
        "groups": [
            _group(index, group, cell, media)
            for index, (group, (cell, _)) in enumerate(zip(groups, cells, strict=True))
        ],
        "number_of_runs": len(runs),
        "singles": len(runs) <= _MOST_SINGLE,
        "singles_label": "single runs" if len(runs) > len(groups) else "single batches",
        "notes": [note for _, notes in cells for note in notes] + _short_runs(groups),
        "cells": [
            _row(group, cell)
            for group, (cell, _) in zip(groups, cells, strict=True)
            if cell is not None
        ],
        "has_paper": has_paper,
        "has_published": any(cell.published for cell in known),
        "measure": f"{measure[0].upper()}{measure[1:]}",
        "returns": curves,
        "episodes": episodes,
        "health": health,
        "constants": [f"{name} {number(value)}" for name, value in constants(groups).items()],
        "same_returns": _same_returns(runs) if episodes is None else "",
        "numbers": _numbers(groups),
        "unit": facts.unit_of(recipe),
        "curves_text": _curves_text(groups),
        "findings": facts.findings(groups),
        "checked": facts.checked_metrics(groups),
        "films": [_film(groups[i], media.runs[i], film) for i, film in media.films.items()],
        "media_notes": media.notes,
        "explained": [
            {"label": groups[i].label, "steps": [_explained(step) for step in steps]}
            for i, steps in media.explained.items()
            if steps
        ],
        "over_time": _frames([groups[i] for i in media.explained]),
        "between": facts.differences([group.recipe for group in groups]),
        "commands": _commands(groups),
        "files": _files(groups),
        "runs": [_run(group, data) for group, data in runs],
        **_versions([data for _, data in runs]),
        "charts_json": _charts_json(drawn),
    }


def _sections(media: Media) -> list[tuple[str, str]]:
    found = [("results", "Results"), ("learning", "Learning curves"), ("health", "Health")]
    if media.films or media.notes:
        found.append(("agent", "The agent at work"))
    if any(media.explained.values()):
        found.append(("looks", "What it looks at"))
    return [*found, ("settings", "Settings"), ("runs", "Runs and versions")]


def _description(groups: Sequence[Group], env: str, algorithm: str) -> str:
    algorithms = dict.fromkeys(group.recipe.algorithm.upper() for group in groups)
    runs = sum(len(group.runs) for group in groups)
    steps = max(data.steps for group in groups for data in group.runs)
    many = f"{len(groups)} experiments, " if len(groups) > 1 else ""
    each = " each" if runs > 1 else ""
    return (
        f"{env}, {' and '.join(algorithms)}: {many}{runs} run{'s' * (runs > 1)} of "
        f"{steps:,} {facts.unit_of(groups[0].recipe)}{each}"
    )


def _title(groups: Sequence[Group]) -> str:
    """The recipe's name, what the names of several have in common, or the task."""
    names = [group.experiment.name for group in groups]
    if len(names) == 1:
        return groups[0].recipe.name or groups[0].label
    levels = zip(*(name.split("/")[:-1] for name in names), strict=False)
    common = [level[0] for level in takewhile(lambda level: len({*level}) == 1, levels)]
    return "/".join(common) if len(common) > 1 else groups[0].recipe.env


def _group(index: int, group: Group, cell: Cell | None, media: Media) -> dict[str, Any]:
    colour, dash = style(index)
    recipe = group.recipe
    named = facts.named_recipe(recipe)
    changes = facts.changes(named, recipe) if named else []
    backbone = recipe.backbone
    weights = media.parameters.get(index)
    network = (
        f"Network: frame encoder {backbone.frame.name}, history encoder {backbone.history.name}, "
        f"{backbone.num_frames} observation{'s' * (backbone.num_frames > 1)} at a time"
        + (f", {weights:,} weights in the policy" if weights else "")
        + "."
    )
    if named is None:
        compared = "No recipe of that name comes with this version, so all settings stand below."
    elif changes:
        compared = f"What differs from the recipe {recipe.name}:"
    else:
        compared = f"All settings are those of the recipe {recipe.name}."
    value, interval, sentence = facts.headline(group, cell)
    paper = ""
    if cell is not None and cell.paper_mean == cell.paper_mean:
        paper = f"{number(cell.paper_mean)} ± {spread(cell.paper_std)}"
    return {
        "index": index,
        "label": group.label,
        "colour": colour,
        "dash": dash,
        "runs": group.runs,
        "value": value,
        "interval": interval,
        "sentence": sentence,
        "paper": paper,
        "recipe_name": recipe.name,
        "changes": changes,
        "settings_text": f"{network} {compared}",
        "settings": facts.settings_of(recipe),
    }


def _row(group: Group, cell: Cell) -> dict[str, Any]:
    several = cell.runs > 1
    interval = f" [{number(cell.low)}, {number(cell.high)}]" if several else ""
    known = cell.paper_mean == cell.paper_mean
    return {
        "label": group.label,
        "runs": cell.runs,
        "iqm": f"{number(cell.iqm)}{interval}",
        "mean": number(cell.mean) + (f" ± {spread(cell.std)}" if several else ""),
        "episodes": spread(cell.std_episodes),
        "paper": f"{number(cell.paper_mean)} ± {spread(cell.paper_std)}" if known else "-",
        "published": [
            (result, f"{number(result.mean)} ± {spread(result.std)}") for result in cell.published
        ],
    }


def _numbers(groups: Sequence[Group]) -> list[list[str]]:
    """The mean training returns of each group at a few steps."""
    last = max(data.steps for group in groups for data in group.runs)
    rows = []
    for low, high in zip(*_edges(last), strict=True):
        row = [f"{high:,.0f}"]
        for group in groups:
            values = []
            for data in group.runs:
                steps, returns = data.metrics["step"], data.metrics["return_mean"]
                inside = returns[(steps > low) & (steps <= high) & np.isfinite(returns)]
                values += [inside.mean()] if len(inside) else []
            row.append(number(float(f"{np.mean(values):.4g}")) if values else "-")
        rows.append(row)
    return rows


def _edges(last: int) -> tuple[np.ndarray, np.ndarray]:
    edges = np.linspace(0, last, _ROWS)
    return edges[:-1], edges[1:]


def _curves_text(groups: Sequence[Group]) -> str:
    several = any(len(group.runs) > 1 for group in groups)
    bold = "Bold lines are interquartile means over runs, bands their 95% bootstrap intervals"
    alone = "The bold line is the mean of five batches, the thin one that of each batch"
    text = bold if several else alone
    if groups[0].recipe.offline:
        text = bold if several else "Each point is an evaluation"
    return f"{text}. Where there are more than 400 rows, neighbours are averaged."


def _short_runs(groups: Sequence[Group]) -> list[str]:
    """Names the runs that bold lines leave out, because they are shorter than the others."""
    return [
        f"{group.label}, {data.label} is at {data.steps:,} of {longest:,} "
        f"{facts.unit_of(group.recipe)}: bold lines leave it out."
        for group in groups
        for longest in [max(data.steps for data in group.runs)]
        for data in group.runs
        if data.steps < FAR * longest
    ]


def _same_returns(runs: Sequence[tuple[Group, RunData]]) -> str:
    """The text that replaces the chart of evaluation episodes if all returns are the same."""
    returns = [value for _, run in runs if run.evaluation for value in run.evaluation["returns"]]
    if not returns:
        return ""
    return f"All {len(returns):,} evaluation episodes have the return {number(returns[0])}."


def _film(group: Group, data: RunData, film: Film) -> dict[str, str]:
    cut = f"; the film shows the first {film.shown:,}" if film.shown < film.steps else ""
    many = len(film.returns)
    of = f"{data.run.folder.name}, " if len(group.runs) > 1 else ""
    middle = ", the run in the middle by its evaluation" if len(group.runs) > 1 else ""
    caption = (
        f"{group.label}: the first {f'{many} episodes' if many > 1 else 'episode'} of its "
        f"evaluation ({of}episode seed {film.seed}{' and on' if many > 1 else ''}{middle}). Return "
        f"{', '.join(map(number, film.returns))} in {film.steps:,} steps{cut}."
    )
    return {
        "video": _data("video/mp4", film.video),
        "poster": _data("image/png", film.poster),
        "caption": caption,
        "alt": f"Film of {group.recipe.env}. {caption}",
    }


def _explained(step: Explained) -> dict[str, Any]:
    return {
        "number": step.step,
        "picture": _data("image/png", step.picture),
        "alt": step.alt,
    }


def _frames(groups: Sequence[Group]) -> int:
    """The maximum number of observations that networks read; 0 if they read one."""
    most = max((group.recipe.backbone.num_frames for group in groups), default=0)
    return most if most > 1 else 0


def _commands(groups: Sequence[Group]) -> list[str]:
    lines = []
    for group, file in zip(groups, _files(groups), strict=True):
        seeds = " ".join(str(data.run.recipe.seed) for data in group.runs)
        named = facts.named_recipe(group.recipe)
        name = group.recipe.name
        source = name if named and not facts.changes(named, group.recipe) else file["name"]
        if len(group.runs) == 1:
            lines.append(f"torchrl-tit train {shlex.quote(source)} --seed {seeds}")
        else:
            lines.append(f"torchrl-tit sweep {shlex.quote(source)} --seeds {seeds}")
    return lines


def _files(groups: Sequence[Group]) -> list[dict[str, str]]:
    """The settings of each group as a file that `train` takes."""
    files = []
    for index, group in enumerate(groups):
        name = "recipe.json" if len(groups) == 1 else f"recipe-{index + 1}.json"
        text = recipe_to_json(group.recipe).encode()
        files.append({"name": name, "data": _data("application/json", text)})
    return files


def _run(group: Group, data: RunData) -> dict[str, Any]:
    evaluation = data.evaluation
    seconds = data.seconds
    return {
        "folder": "/".join(data.run.folder.absolute().parts[-3:]),
        "group": group.label,
        "seed": data.run.recipe.seed,
        "steps": f"{data.steps:,}",
        "evaluation": (
            f"{number(evaluation['mean'])} ± {spread(evaluation['std'])}" if evaluation else "-"
        ),
        "episodes": evaluation["episodes"] if evaluation else "-",
        "time": duration(seconds) if seconds else "-",
        "speed": f"{data.steps / seconds:,.0f}" if seconds else "-",
    }


def _versions(runs: Sequence[RunData]) -> dict[str, Any]:
    """A column for each set of versions, which runs of the same versions share."""
    columns: dict[str, list[RunData]] = {}
    for data in runs:
        if data.versions:
            columns.setdefault(json.dumps(data.versions, sort_keys=True), []).append(data)
    found = [json.loads(text) for text in columns]
    names = dict.fromkeys(name for versions in found for name in versions)
    alone = len(columns) == 1
    return {
        "versions": [
            {"name": name, "cells": [versions.get(name, "-") for versions in found]}
            for name in names
        ],
        "version_columns": [
            "version" if alone else ", ".join(data.run.folder.name for data in members)
            for members in columns.values()
        ],
    }


def _charts_json(charts: Sequence[Chart]) -> str:
    """The charts for the page's script; "<" is escaped so that no text can end the script."""
    parts = (f'{{"column": {json.dumps(c.column)}, "figure": {c.figure}}}' for c in charts)
    return f"[{', '.join(parts)}]".replace("<", "\\u003c")


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _render(context: dict[str, Any]) -> str:
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"code": _code, "sentence": _sentence}
    files = resources.files(__package__)
    page, css, js = (
        files.joinpath(name).read_text(encoding="utf-8")
        for name in ("page.html", "page.css", "page.js")
    )
    template = environment.from_string(page)
    return template.render(**context, css=css, js=js, plotly=get_plotlyjs())


def _code(text: str) -> str:
    """Escapes a text and formats what is between backticks as code; returns HTML."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))


def _sentence(text: str) -> str:
    """As :func:`_code`, with a capital letter at the start and a full stop at the end."""
    text = text if text[0] in "`0123456789" else f"{text[0].upper()}{text[1:]}"
    return _code(f"{text}.")
