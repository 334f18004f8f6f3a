"""`examples`: the scripts that the pages explain, to start from."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl_tit.files import whole_or_not_at_all

from .arguments import Parser, say

_HERE = Path(__file__).parents[2]
"""The installed package, or a clone."""


def examples(arguments: list[str]) -> None:
    """Copies the examples into a new folder."""
    parser = Parser(
        "examples",
        "Copy the examples into a new folder: PPO, DQN, SAC and IQL of TorchRL with a TIT "
        "backbone, programs that act from exported files, and a package of encoders, tasks and "
        "algorithms of one's own.",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder to make")
    out = parser.parse_args(arguments).out
    folders = (_HERE / "examples", _HERE / "docs" / "examples")
    source = next(folder for folder in folders if folder.is_dir())
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with whole_or_not_at_all(out) as hidden:
        shutil.copytree(source, hidden, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    say("\n".join(str(path) for path in sorted(out.rglob("*")) if path.is_file()))
