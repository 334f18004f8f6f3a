"""The commands. Each is imported only when it is called, so that all start quickly."""

from __future__ import annotations

import sys

from torchrl_tit.settings import resolve

from .arguments import fail, program

COMMANDS = {
    "list": "named_recipes:list_recipes",
    "show": "named_recipes:show",
    "train": "train:train",
    "evaluate": "evaluate:evaluate",
    "render": "evaluate:render",
    "sweep": "sweep:sweep",
    "tune": "sweep:tune",
    "compare": "compare:compare",
    "table": "compare:table",
    "data": "data:data",
}
"""The commands by name, each a "module:function" of this package."""

USAGE = """\
usage: {program} COMMAND ...

  list [PATTERN]              list the named recipes whose name contains PATTERN
  show NAME                   print a recipe's settings as JSON
  train NAME [--FIELD VALUE]  train a named recipe, or one in a JSON file;
                              `train NAME --help` explains every field
  train --resume RUN          resume a run that was stopped or killed
  evaluate RUN                evaluate a run's newest checkpoint
  render RUN --out FILE       film a run's agent: a GIF or MP4
  sweep NAME [NAME ...]       train many recipes and seeds at once; names can be patterns
  tune NAME --out FOLDER      search for the best values of a recipe's fields, with Optuna
  compare RUN [RUN ...]       plot learning curves of several runs, a recipe's seeds as one band
  table FOLDER [FOLDER ...]   print the paper's tables with all runs in the folders
  data info SOURCE            describe a data set: an HDF5 file, D4RL's or Minari's name
  data convert SOURCE TARGET  convert between HDF5 in D4RL's layout and Minari
  data collect TASK           make medium, mixed, expert and random data sets, as D4RL does

Common options: --seed, --out, --device, --threads where they apply; see COMMAND --help.
"""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line.

    Args:
        arguments: the arguments after the program's name; those of this process if None.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE.format(program=program()))
        return
    name, *rest = arguments
    if name not in COMMANDS:
        print(USAGE.format(program=program()), file=sys.stderr)
        fail(f"unknown command {name!r}: choose from {', '.join(COMMANDS)}")
    try:
        resolve(f"{__package__}.{COMMANDS[name]}")(rest)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `list | head`: the reader is gone
        sys.stdout = None
    except (ValueError, OSError, RuntimeError, FloatingPointError) as error:
        fail(str(error))
