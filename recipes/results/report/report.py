"""Writes the report of runs: one self-contained HTML file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from torchrl_tit import load_agent
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.files import write_text_atomic

from ..cell import Cell
from ..table import make_table
from .media import Media, explain_steps, film_episodes
from .page import write_page
from .run_data import Group, RunData, read_groups


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
        folders: run folders, or folders with run folders somewhere below.
        out: the HTML file to write.
        title: its title; by default what the names of the runs' recipes have in common.
        pictures: whether to film and explain the agents, which takes most of the time.
        say: called with a line before each slow part.

    Raises:
        OSError: if the file cannot be written, or a checkpoint is damaged.
        ValueError: if a folder holds no run, a run is damaged, or runs cannot be compared.
    """
    _check_out(out)
    groups = read_groups(folders)
    cells = [_cell(group) for group in groups]
    media = _make_media(groups, say) if pictures else Media()
    write_text_atomic(out, write_page(groups, cells, media, title))


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


def _cell(group: Group) -> tuple[Cell | None, list[str]]:
    """The row of a table of results, and notes on it."""
    try:
        (cell,), notes = make_table([data.run.folder for data in group.runs])
    except ValueError:  # none of the runs is trained and evaluated
        return None, [f"{group.label} is not evaluated yet: there is no run that is complete."]
    return cell, notes


def _make_media(groups: Sequence[Group], say: Callable[[str], None]) -> Media:
    media = Media()
    # A single experiment is shown at three moments, each of several experiments at one.
    without = []
    moments = (0.05, 0.5, 0.95) if len(groups) == 1 else (0.5,)
    for index, group in enumerate(groups):
        data = _typical(group)
        run = data.run
        if not checkpoint_steps(run.checkpoints):
            without.append(group.label)
            continue
        say(f"filming and explaining {run.folder}")
        try:
            agent = load_agent(run.folder)
            media.parameters[index] = sum(p.numel() for p in agent.policy.parameters())
            film = media.films[index] = film_episodes(agent)
            media.runs[index] = data
            last = min(film.first_steps, film.shown) - 1
            steps = sorted({min(last, round(share * last)) for share in moments})
            media.explained[index] = explain_steps(agent, steps)
        except (ValueError, ImportError) as error:  # it cannot be rendered, or has no maps
            media.notes.append(f"Not everything of {group.label} is shown: {error}")
    if without:
        media.notes.append(f"No film of {', '.join(without)}: there is no checkpoint.")
    return media


def _typical(group: Group) -> RunData:
    """The run with the median evaluation, so that films show neither the best nor the worst.

    Runs that can act come first.
    """
    can_act = [run for run in group.runs if checkpoint_steps(run.run.checkpoints)]
    runs = can_act or list(group.runs)
    evaluated = [run for run in runs if run.evaluation is not None]
    if not evaluated:
        return runs[0]
    ranked = sorted(evaluated, key=_mean_return)
    return ranked[(len(ranked) - 1) // 2]


def _mean_return(run: RunData) -> float:
    assert run.evaluation is not None
    return float(run.evaluation["mean"])
