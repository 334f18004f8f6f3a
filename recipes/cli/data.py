"""`data`: describes data sets, converts them, or makes them."""

from __future__ import annotations

import argparse
import shlex
from inspect import getdoc
from pathlib import Path
from typing import Annotated

import tyro
from torch import Tensor

from torchrl_tit.datasets import (
    Episodes,
    has_reference,
    load_episodes,
    normalized_score,
    write_hdf5,
    write_minari,
)
from torchrl_tit.datasets.sources import HDF5_SUFFIXES
from torchrl_tit.settings.checks import printable
from torchrl_tit.settings.imports import import_options

from ..core.trust import may_name_task
from ..tools.collect import Collection
from ..tools.collect.collect import collect
from .arguments import Parser, note, parse_fields, program, say


def data(arguments: list[str]) -> None:
    """Describes data sets, converts them, or makes them."""
    if arguments[:1] == ["collect"]:
        return _collect(arguments[1:])
    parser = Parser("data", "Describe data sets, convert them, or make them.")
    _add_options(parser)
    options = parser.parse_args(arguments)
    reading = {
        "task": options.env,
        "max_episode_steps": options.max_episode_steps,
        "gaps": options.gaps,
        "directory": options.directory,
    }
    if options.command == "info":
        say(describe(load_episodes(options.source, **reading)))
    else:
        episodes = load_episodes(options.source, dtype=None, **reading)
        say(convert_episodes(episodes, options.target, options.env))


def _collect(arguments: list[str]) -> None:
    out = tyro.conf.arg(help="Folder of the data, which the same command resumes.")
    parsed = parse_fields(
        [
            ("collection", Annotated[Collection, tyro.conf.arg(name="")]),
            ("out", Annotated[Path, out]),
        ],
        arguments,
        "data collect",
        str(getdoc(Collection)),
    )
    words = [*program().split(), "data", "collect", *arguments, *import_options()]
    try:
        lines = collect(parsed.collection, parsed.out, shlex.join(words))
    except KeyboardInterrupt:
        note("stopped; the same command resumes", "")
        raise
    say("\n".join(lines))


def _add_options(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="info | convert | collect"
    )
    info = commands.add_parser("info", help="describe a data set")
    convert = commands.add_parser("convert", help="convert between D4RL's HDF5 and Minari")
    # Its options are the fields of a dataclass, which parse_fields reads.
    commands.add_parser("collect", add_help=False, help="make data sets of a task, as D4RL does")
    for command in (info, convert):
        command.add_argument("source", help="HDF5 file, Minari folder, D4RL's or Minari's name")
        command.add_argument("--env", help="Gymnasium task that the data must fit")
        command.add_argument(
            "--max-episode-steps", type=int, help="time limit of a file without timeouts"
        )
        command.add_argument(
            "--gaps",
            choices=["error", "cut"],
            default="error",
            help="refuse data with gaps in next observations or timestamps, or end the episode "
            "there",
        )
        command.add_argument("--directory", type=Path, help="folder for temporary files")
    convert.add_argument("target", help="HDF5 file, Minari folder (/PATH-v0 or ./PATH-v0) or name")


def describe(episodes: Episodes) -> str:
    """Describes the size and the contents of a data set.

    Args:
        episodes: the data.

    Returns:
        Transitions, episodes, returns, normalized scores (if any), shapes and dtypes.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> ends = [False, True, False, True]
        >>> episodes = episodes_from_arrays([[1.0], [2.0], [3.0], [4.0]], [0, 1, 1, 0], ends, ends)
        >>> print(describe(episodes))
        source        the data
        transitions   4
        episodes      2 (2 terminated, 0 truncated, 0 unfinished)
        length        min 2, mean 2.0, max 2
        return        min 1.000, mean 1.000, max 1.000
        score         no reference returns for this task
        observation   [1] float32
        action        [] int64
        reward        [1] float32
        note          without next_observations: what episodes ended in is unknown
    """
    terminated, finished = episodes.terminated, episodes.finished
    lengths = episodes.lengths.double()
    returns, task = episodes.returns[episodes.is_whole], _scored_name(episodes)
    unscored = "no reference returns for this task"
    counts = {
        "terminated": int(terminated.sum()),
        "truncated": int((finished & ~terminated).sum()),
        "unfinished": int((~finished).sum()),
    }
    kinds = ", ".join(f"{count} {name}" for name, count in counts.items())
    kinds += _parts(episodes)
    lines = {
        "source": episodes.source,
        "transitions": str(episodes.num_transitions),
        "episodes": f"{len(lengths)} ({kinds})",
        "length": f"min {lengths.min():.0f}, mean {lengths.mean():.1f}, max {lengths.max():.0f}",
        "return": _range(returns),
        "score": _range(normalized_score(returns, task)) if task else unscored,
    }
    for field in ("observation", "action", "reward"):
        values = episodes.rows[field]
        lines[field] = f"{list(values.shape[1:])} {str(values.dtype).removeprefix('torch.')}"
    if not episodes.final_known.all():
        lines["note"] = "without next_observations: what episodes ended in is unknown"
    if episodes.left_out:
        lines["not read"] = ", ".join(episodes.left_out)
    lines.update({name: str(value) for name, value in episodes.attributes.items()})
    return "\n".join(f"{printable(name):<13} {printable(text)}" for name, text in lines.items())


def convert_episodes(episodes: Episodes, target: str, env_name: str | None = None) -> str:
    """Writes a data set as an HDF5 file in D4RL's layout or as a Minari data set.

    Args:
        episodes: the data.
        target: a file ending in ".hdf5" or ".h5", or a folder or name for Minari.
        env_name: the Gymnasium task that the data are from, for Minari; by default the recorded
            one, if Gymnasium knows it.

    Returns:
        A message that says what was written and what was left out.

    Raises:
        FileExistsError: if there is something at the target already.
        ValueError: if the target's name cannot be used, or the data do not fit its layout.
        OSError: if it cannot be written.

    Example:
        >>> import tempfile
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> target = Path(tempfile.mkdtemp()) / "a.hdf5"
        >>> episodes = episodes_from_arrays([[1.0], [2.0]], [0, 1], [1.0, 1.0], [False, True])
        >>> convert_episodes(episodes, str(target)).startswith("2 transitions in 1 episodes")
        True
    """
    if Path(target).suffix in HDF5_SUFFIXES:
        Path(target).absolute().parent.mkdir(parents=True, exist_ok=True)
        write_hdf5(episodes, target)
    else:
        recorded = episodes.attributes.get("env_id")
        known = str(recorded) if may_name_task(recorded) else None
        write_minari(episodes, target, env_name or known)
    text = (
        f"{episodes.num_transitions} transitions in {len(episodes.lengths)} episodes written to "
        f"{target}{_parts(episodes)}"
    )
    if episodes.left_out:
        text += f"\nnot converted: {', '.join(episodes.left_out)}"
    return text


def _parts(episodes: Episodes) -> str:
    """How many episodes are parts of others, or were going on when the recording ended."""
    count = int(episodes.cut.sum())
    return f"; {count} are parts of others, cut at gaps" if count else ""


def _scored_name(episodes: Episodes) -> str | None:
    """Returns the recorded task, else the data set's name, if it has reference returns."""
    source = Path(episodes.source)
    name = source.name if source.exists() else episodes.source  # no folder names a task
    name = str(episodes.attributes.get("env_id", name))
    return name if has_reference(name) else None


def _range(values: Tensor) -> str:
    if not len(values):
        return "no episode is whole"
    return f"min {values.min():.3f}, mean {values.mean():.3f}, max {values.max():.3f}"
