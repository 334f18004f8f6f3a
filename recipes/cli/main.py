"""The commands. Each is imported only when it is called, so that all start quickly."""

from __future__ import annotations

import os
import sys

import torchrl_tit
from torchrl_tit.extras import EXTRAS, missing
from torchrl_tit.settings import resolve
from torchrl_tit.settings.checks import nearest

from .arguments import fail, import_what_is_typed, one_line_warnings, program, refuse_repeated

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # of TorchRL, which is imported later

COMMANDS = {
    "list": "named_recipes:list_recipes",
    "show": "named_recipes:show",
    "train": "train:train",
    "evaluate": "evaluate:evaluate",
    "explain": "agents:explain",
    "sweep": "sweep:sweep",
    "tune": "sweep:tune",
    "play": "agents:play",
    "share": "agents:share",
    "export": "agents:export",
    "compare": "results:compare",
    "summary": "results:summary",
    "table": "results:table",
    "record": "results:record",
    "report": "results:report",
    "data": "data:data",
    "examples": "named_recipes:examples",
}
"""The commands by name, each a "module:function" of this package."""

_OF_USERS = (ValueError, OSError, RuntimeError, FloatingPointError, ImportError, MemoryError)
"""Errors caused by a user's mistake or by a limit of the machine."""

USAGE = """\
usage: {program} COMMAND ...

  list [PATTERN]              list the named recipes whose name contains PATTERN
  show NAME                   print a recipe's settings as JSON
  train NAME [--FIELD VALUE]  train a named recipe, or one in a JSON or Python file (FILE.py:NAME;
                              the file is run); `train NAME --help` explains every field
  train NAME --init-from RUN  start from the weights of another run
  train --resume RUN          resume a run that was stopped or killed; with --total-steps N (or
                              --total-updates, --iterations, --rounds) train a finished one further
  evaluate RUN                evaluate a run's newest checkpoint
  explain AGENT --out FILE    film what a trained agent looks at, or draw one step of it as PNG
  play [AGENT] [--out FILE]   let a trained agent play and film it as GIF or MP4; without AGENT,
                              list those that come with torchrl-tit
  share RUN REPO              make an agent of a run and upload it to the Hugging Face Hub; with
                              --out FOLDER, write it to a folder
  export AGENT --out FILE     write its policy as .pt2 (torch.export) or .onnx, which act without
                              torchrl-tit
  sweep NAME [NAME ...]       train many recipes and seeds at once; names can be patterns
  tune NAME --out FOLDER      search for the best values of a recipe's fields, with Optuna
  compare RUN [RUN ...]       plot learning curves of several runs, a recipe's seeds as one band,
                              and test which recipe is better than the first
  summary FOLDER [FOLDER ...] print how well networks do over several tasks
  table FOLDER [FOLDER ...]   print the paper's tables with all runs in the folders
  record RUN... --out FOLDER  add finished runs to a table of runs, which lies beside the code;
                              compare, table and report read it
  report RUN... --out FILE    write everything about runs into one HTML file, to send to a colleague
  data info SOURCE            describe a data set: an HDF5 file, D4RL's or Minari's name
  data convert SOURCE TARGET  convert between HDF5 in D4RL's layout and Minari
  data collect TASK           make medium, mixed, expert and random data sets, as D4RL does
  examples OUT                copy the examples of the documentation into a new folder

Common options: --seed, --out, --device, --threads where they apply; see COMMAND --help.
Every command takes --import MODULE, for recipes, encoders, algorithms and tasks of your own.
--version prints the version.
"""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line.

    Args:
        arguments: the arguments after the program's name; those of this process if None.
    """
    try:
        try:
            with one_line_warnings():
                _run(import_what_is_typed(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()  # here, because a closed pipe is handled below
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `list | head`: discard the rest of the output
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except _OF_USERS as error:
        fail(_describe(error))


def _describe(error: Exception) -> str:
    package = (error.name or "").partition(".")[0] if isinstance(error, ImportError) else ""
    if package in EXTRAS:
        return missing(package)
    text = str(error) or type(error).__name__
    # PyTorch raises RuntimeErrors when a CPU or a GPU runs out of memory.
    if isinstance(error, MemoryError) or "allocate memory" in text or "out of memory" in text:
        return (
            "there is not enough memory: a smaller network, num_frames, num_envs, minibatch_size "
            f"or batch_size needs less ({text})"
        )
    if isinstance(error, FileExistsError | NotADirectoryError) and error.filename:
        return (
            f"{error.strerror}: {error.filename!r}: a file is in the way, so choose another place"
        )
    return text


def _run(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE.format(program=program()))
        return
    if arguments[0] == "--version":
        print(f"torchrl-tit {torchrl_tit.__version__}")
        return
    name, *rest = arguments
    if name not in COMMANDS:
        fail(f"unknown command {name!r}: {nearest(name, COMMANDS)} (see `{program()} --help`)")
    refuse_repeated(rest)
    resolve(f"{__package__}.{COMMANDS[name]}")(rest)
