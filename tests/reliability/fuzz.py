"""Gives wrong inputs to recipes, networks, data sets and the command line: `make fuzz`.

Hypothesis makes the inputs from nonsense in the places of good values. Each must be refused in one
line, or do what it says; anything else is a fault, which is printed. Hostile files, which are made
to run something, to read other files or to fill the memory: see tests/datasets/test_hostile.py.

The same inputs are made each time: `--inputs 10000` goes further.
"""

import argparse
import contextlib
import io
import json
import re
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import h5py
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from recipes.cli import main as command_line
from recipes.cli import training
from recipes.cli.main import COMMANDS
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import RECIPES
from tests.datasets.hostile import good_arrays
from torchrl_tit.datasets import Episodes, episodes_from_arrays, load_episodes, write_minari
from torchrl_tit.networks import build_network
from torchrl_tit.settings import DecisionTransformer
from torchrl_tit.settings.networks import NETWORKS

NUMBERS = [-1, 0, 1, 3, 2.5, 10**30, -(10**30), 1e-300, 1e300, float("nan"), float("inf")]
TEXTS = ["", "no", "auto", "1", "nan", "☃", "a\nb", "os:system", "x" * 5000]
NONSENSE: st.SearchStrategy[Any] = st.sampled_from(
    [None, True, *NUMBERS, *TEXTS, [], [1], ["a"], {}, {"a": 1}, [[[]]]]
)
WORDS = ["", "nope", "-1", "0", "1e30", "nan", "--", "-", ".", "/dev/null", "☃", "a\nb", "a b", "*"]
OPTIONS = ["--seed", "--out", "--episodes", "--device", "--import", "--import os:system", "--x"]
SHAPES = [(4,), (8, 8), (3, 36, 36), 4, (0,), (4.5,), (2,) * 4, None, "ab"]


class Outcome(NamedTuple):
    """What became of the inputs of one kind."""

    counts: Counter[str]
    faults: list[str]


def put_somewhere(draw: st.DrawFn, value: Any) -> Any:
    """Replaces one part of nested dictionaries and lists by nonsense, or drops or renames it."""
    if not isinstance(value, dict | list) or not value or draw(st.integers(0, 3)) == 0:
        return draw(NONSENSE)
    key = draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
    changed = value.copy()
    match draw(st.integers(0, 9)), changed:
        case 0, dict():
            changed[f"{key}s"] = changed.pop(key)
        case 1, _:
            del changed[key]
        case _:
            changed[key] = put_somewhere(draw, value[key])
    return changed


@st.composite
def cut_or_flipped(draw: st.DrawFn, content: bytes) -> bytes:
    """Content that ends too early, or has a wrong byte."""
    place = draw(st.integers(0, len(content) - 1))
    if draw(st.booleans()):
        return content[:place]
    return content[:place] + bytes([draw(st.integers(0, 255))]) + content[place + 1 :]


@st.composite
def recipes(draw: st.DrawFn) -> bytes:
    """A recipe.json."""
    text = recipe_to_json(RECIPES[draw(st.sampled_from(sorted(RECIPES)))])
    if draw(st.integers(0, 5)) == 0:
        return draw(cut_or_flipped(text.encode()))
    return json.dumps(put_somewhere(draw, json.loads(text))).encode()


def try_recipe(text: bytes) -> str:
    recipe = recipe_from_json(text, "recipe.json")
    # Nonsense may be a value of a field; the recipe is then one that can be written and read.
    assert recipe_from_json(recipe_to_json(recipe), "again.json") == recipe
    return "right"


@st.composite
def networks(draw: st.DrawFn) -> tuple[str, Any, dict[str, Any]]:
    """A network's name, what it reads and its settings."""
    name = draw(st.sampled_from(sorted(NETWORKS)))
    shape = draw(st.sampled_from(SHAPES))
    names = ["num_frames", "embed_dim", "features_dim", "num_blocks", "num_heads", "patch_size"]
    names += ["dropout", "ffn_expansion", "hidden_dim", "temporal_positions", "nonsense"]
    names += ["position_encoding", "num_heads_inner", "activation", "activation_inner", "dense"]
    changed = draw(st.lists(st.sampled_from(names), max_size=3, unique=True))
    small = st.sampled_from([1, 2, 4, 8])
    return name, shape, {key: draw(st.one_of(NONSENSE, small)) for key in changed}


def try_network(case: tuple[str, Any, dict[str, Any]]) -> str:
    name, shape, fields = case
    network = NETWORKS[name](**fields)
    reads_actions = isinstance(network.history, DecisionTransformer)
    built = build_network(network, shape, action_dim=2 if reads_actions else None)
    assert all(weights.isfinite().all() for weights in built.parameters())
    return "right"


@cache
def good_metadata() -> dict[str, Any]:
    """What Minari writes about a data set."""
    with tempfile.TemporaryDirectory() as folder:
        write_minari(episodes_from_arrays(**good_arrays()), Path(folder, "a-v0"))
        return json.loads(Path(folder, "a-v0", "data", "metadata.json").read_text())


@st.composite
def data_sets(draw: st.DrawFn) -> Callable[[Path], Path]:
    """A function that writes a data set into a folder."""
    arrays: dict[str, Any] = good_arrays()
    form = draw(st.sampled_from(["arrays", "arrays", "bytes", "metadata"]))
    name = draw(st.sampled_from(sorted(arrays)))
    change = draw(st.sampled_from(["drop", "short", "nan", "text", "scalar", "wide", "large", "0"]))
    place, byte = draw(st.floats(0, 0.999)), draw(st.integers(0, 255))
    metadata = json.dumps(put_somewhere(draw, good_metadata())) if form == "metadata" else ""

    def write(folder: Path) -> Path:
        if form == "metadata":
            write_minari(episodes_from_arrays(**arrays), folder / "a-v0")
            (folder / "a-v0" / "data" / "metadata.json").write_text(metadata)
            return folder / "a-v0"
        fields = dict(arrays)
        if form == "arrays":
            values = fields.pop(name)
            changed: dict[str, Callable[[], Any]] = {
                "short": lambda: values[:-1],
                "nan": lambda: np.where(np.arange(len(values)) == 7, np.nan, values.T).T,
                "text": lambda: values.astype("S5"),
                "scalar": lambda: np.float32(0),
                "wide": lambda: np.stack([values] * 3, -1),
                "large": lambda: values.astype(np.float64) + 1e300,
                "0": lambda: values[:0],
            }
            if change in changed:
                fields[name] = changed[change]()
        with h5py.File(folder / "a.hdf5", "w") as file:
            for field, values in fields.items():
                file[field] = values
        if form == "bytes":
            content = bytearray((folder / "a.hdf5").read_bytes())
            content[int(place * len(content))] = byte
            (folder / "a.hdf5").write_bytes(content)
        return folder / "a.hdf5"

    return write


def try_data_set(write: Callable[[Path], Path]) -> str:
    with tempfile.TemporaryDirectory() as folder:
        episodes = load_episodes(write(Path(folder)))
    assert isinstance(episodes, Episodes)
    assert all(field.isfinite().all() for field in episodes.rows.values())
    return "right"


@st.composite
def commands(draw: st.DrawFn) -> list[str]:
    """Words that are typed."""
    word = st.sampled_from(WORDS)
    command = draw(st.sampled_from([*COMMANDS, "trian", "-h", "--version"]))
    if command == "train" and draw(st.integers(0, 4)):
        recipe = RECIPES[name := draw(st.sampled_from(sorted(RECIPES)))]
        fields = [field.replace("_", "-") for field in vars(recipe) if field != "backbone"]
        return ["train", name, f"--{draw(st.sampled_from(fields))}", draw(word)]
    if command == "data":
        words = [command, draw(st.sampled_from(["info", "convert", "collect", "x"]))]
    else:
        words = [command]
    for _ in range(draw(st.integers(0, 3))):
        kind = draw(st.sampled_from([WORDS, OPTIONS, ["--help"]]))
        words += draw(st.sampled_from(kind)).split(" ")
    return words


def try_command(words: list[str]) -> str:
    errors, out = io.StringIO(), io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        mock.patch.object(training, "start"),  # what is right would train for hours
        mock.patch.object(sys, "argv", ["torchrl-tit"]),
        contextlib.redirect_stderr(errors),
        contextlib.redirect_stdout(out),
    ):
        code: str | int = 0
        try:
            command_line(words)
        except SystemExit as end:
            code = end.code or 0
    if code == 0:
        return "right"
    lines = errors.getvalue().splitlines()
    reasons = [line for line in lines if line.startswith("error: ")]
    if code != 2 or len(reasons) != 1 or any(line.startswith("Traceback") for line in lines):
        raise AssertionError(f"exit code {code} and {errors.getvalue()[-500:]!r}")
    raise ValueError(reasons[0])


KINDS: dict[str, tuple[st.SearchStrategy[Any], Callable[[Any], str]]] = {
    "recipes": (recipes(), try_recipe),
    "networks": (networks(), try_network),
    "data sets": (data_sets(), try_data_set),
    "command lines": (commands(), try_command),
}


def fuzz(kind: str, inputs: int) -> Outcome:
    """Tries inputs of one kind, the same each time."""
    strategy, attempt = KINDS[kind]
    outcome = Outcome(Counter(), [])

    @settings(
        max_examples=inputs,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def run(case: Any) -> None:
        outcome.counts[one(kind, attempt, case, outcome.faults)] += 1

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run()
    return outcome


def one(kind: str, attempt: Callable[[Any], str], case: Any, faults: list[str]) -> str:
    """Tries one input; returns what became of it, and adds what should not have."""
    try:
        return attempt(case)
    except (ValueError, OSError) as error:
        if str(error).strip() and "\n" not in str(error):
            return "refused"
        problem = f"{type(error).__name__}: {error!s}"
    except TypeError as error:
        if re.search(r"\(\) got an unexpected keyword argument|missing \d+ required", str(error)):
            return "refused"  # Python's own words
        problem = traceback.format_exc(limit=-2)
    except Exception:
        problem = traceback.format_exc(limit=-2)
    faults.append(f"{kind}: {case!r:.500}: {problem}")
    return "fault"


def main() -> None:
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="in all, a quarter of each kind")
    options = parser.parse_args()
    faults: list[str] = []
    print("| inputs | tried | refused in one line | right | faults |\n|---|---|---|---|---|")
    for kind in KINDS:
        outcome = fuzz(kind, options.inputs // len(KINDS))
        tried, counts = sum(outcome.counts.values()), outcome.counts
        print(f"| {kind} | {tried} | {counts['refused']} | {counts['right']} | {counts['fault']} |")
        sys.stdout.flush()
        faults += outcome.faults
    print(*faults, sep="\n")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
