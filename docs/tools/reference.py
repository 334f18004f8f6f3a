"""Writes the pages that follow from the code: ``python -m docs.tools.reference``.

docs/reference/commands.md      what each command's --help prints
docs/reference/fields.md        the fields of recipes and networks, with their bounds and defaults
docs/reference/metrics.md       the columns of metrics.csv
docs/reference/api.md           the public names of each package
build/docs/reference/api/*.md   a page of the site for each package, which mkdocstrings fills in

In docs/ they are between ``<!-- reference: NAME.md -->`` and ``<!-- end -->``; a test compares
them.
The site needs none of this library's dependencies: they are imported here, in its environment.
"""

from __future__ import annotations

import dataclasses
import importlib
import io
import os
import re
import sys
import types
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import docstring_parser
import msgspec

from recipes.cli.main import COMMANDS, USAGE, main
from recipes.core.recipe import recipe_classes
from recipes.tools.results.metric_words import family, known_columns, words_of
from torchrl_tit.settings import NETWORKS, FrameSettings, Head, HistorySettings, Network

ROOT = Path(__file__).parents[2]
_SUBCOMMANDS = {"data": ["data info", "data convert", "data collect"]}
_WITHOUT_LIST = {
    "torchrl_tit.evaluation": ["evaluate", "finished_returns"],
    "torchrl_tit.settings.networks": [function.__name__ for function in NETWORKS.values()],
}
"""Public modules that are no packages, with their public names: see docs/api-stability.md."""
_HUGE = 1e9


def pages() -> dict[str, str]:
    """Returns the pages by their path in docs/reference."""
    api = {f"api/{package}.md": _api(package, names) for package, names in public().items()}
    return {
        "commands.md": _commands(),
        "fields.md": _fields(),
        "metrics.md": _metrics(),
        "api.md": _index(),
        **api,
    }


def fill(page: str, name: str, text: str) -> str:
    """Returns a page of docs/reference with what was written from the code in its place."""
    begin, end = f"<!-- reference: {name} -->\n", "<!-- end -->"
    before, rest = page.split(begin)
    return f"{before}{begin}{text}{end}{rest.split(end)[1]}"


def public() -> dict[str, list[str]]:
    """Returns the public names of each public package, which docs/api-stability.md lists."""
    page = (ROOT / "docs" / "api-stability.md").read_text(encoding="utf-8")
    packages = re.findall(r"^- `([\w.]+)`$", page, flags=re.MULTILINE)
    return {name: [*_import(name).__all__] for name in packages} | _WITHOUT_LIST


# Commands


def _commands() -> str:
    words = [c for command in COMMANDS for c in _SUBCOMMANDS.get(command, [command])]
    summary = "\n".join(line for line in USAGE.splitlines() if line.startswith("  "))
    helps = [f"## {word}\n\n```text\n{_help(word.split())}\n```" for word in words]
    return "\n\n".join([f"```text\n{summary}\n```", *helps]) + "\n"


def _help(words: list[str]) -> str:
    """What a command's --help prints in a window of 96 columns."""
    printed, before = io.StringIO(), (sys.argv, os.environ.get("COLUMNS"))
    sys.argv, os.environ["COLUMNS"] = [str(ROOT / "recipes" / "__main__.py")], "96"
    try:
        with redirect_stdout(printed), suppress(SystemExit):
            main([*words, "--help"])
    finally:
        sys.argv = before[0]
        os.environ.pop("COLUMNS")
        if before[1] is not None:
            os.environ["COLUMNS"] = before[1]
    return printed.getvalue().strip()


# Fields


def _fields() -> str:
    sections: list[str] = []
    seen: set[type] = {object}
    algorithms: dict[Any, str] = {kind: f"`{name}`" for name, kind in _algorithms().items()}
    parts: dict[type, str] = {Network: "The network (`backbone`)", Head: "Its head (`head`)"}
    for table, word in ((FrameSettings, "Frame encoder"), (HistorySettings, "History encoder")):
        parts |= {
            kind: f"{word} `{name}`"
            for name, kind in table.registered.items()
            if kind.__module__.startswith("torchrl_tit.")
        }
    ordered = sorted(algorithms, key=lambda kind: (kind.offline, kind.algorithm))
    for kind in [*ordered, *parts]:
        cls: type
        for cls in reversed(kind.__mro__):
            if cls in seen or not hasattr(cls, "__dataclass_fields__"):
                continue
            seen.add(cls)
            if section := _section(cls, algorithms.get(cls) or parts.get(cls)):
                sections.append(section)
    return "\n".join(sections)


def _algorithms() -> dict[str, Any]:
    """The recipes of this package, by the name of their algorithm."""
    registered = recipe_classes().items()
    return {name: kind for name, kind in registered if kind.__module__.startswith("recipes.")}


def _section(cls: type, title: str | None) -> str:
    """A class's own fields; those that it inherits stand in another section."""
    rows = list(_rows(cls))
    if title is None and not rows:
        return ""
    above = [
        f"[`{base.__name__}`](#{base.__name__.lower()})"
        for base in cls.__mro__[1:]
        if dataclasses.is_dataclass(base) and list(_rows(base))
    ]
    title, anchor = title or f"`{cls.__name__}`", cls.__name__.lower()
    text = [] if title.lower() == f"`{anchor}`" else [f'<a id="{anchor}"></a>', ""]
    text += [f"## {title}", "", (cls.__doc__ or "").split("\n\n")[0].strip(), ""]
    if above:
        text += [f"Beside its own it has the fields of {', '.join(above)}.", ""]
    if rows:
        text += ["| field | takes | default | |", "|---|---|---|---|", *rows, ""]
    return "\n".join(text)


def _rows(cls: type) -> Iterator[str]:
    own = vars(cls).get("__annotations__", {})
    hints = get_type_hints(cls, include_extras=True)
    said = {p.arg_name: p.description or "" for p in docstring_parser.parse_from_object(cls).params}
    for field in dataclasses.fields(cls):
        if field.name in own and field.name != "name":
            cells = [f"`{field.name}`", takes(hints[field.name]), _default(field)]
            text = " ".join(said.get(field.name, "").split()).replace("|", "\\|")
            yield f"| {' | '.join(cells)} | {text} |"


def takes(kind: Any) -> str:
    """Says in words what a type accepts.

    Example:
        >>> from torchrl_tit.settings.numbers import Fraction, Width
        >>> takes(Width | None), takes(Fraction), takes(Literal["auto", "on"])
        ('integer from 1 to 65536, or nothing', 'number from 0 to 1', '`auto`, `on`')
    """
    if get_origin(kind) is Annotated:
        of, *extras = get_args(kind)
        bounds = [extra for extra in extras if isinstance(extra, msgspec.Meta)]
        return takes(of) + "".join(_words(bound) for bound in bounds)
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    if get_origin(kind) in (Union, types.UnionType):
        return ", or ".join(takes(part) for part in get_args(kind))
    if get_origin(kind) is tuple:
        return f"several of: {takes(get_args(kind)[0])}"
    words = {int: "integer", float: "number", bool: "on or off", str: "text", type(None): "nothing"}
    if kind in words:
        return words[kind]
    return "[a network](#network)" if kind is Network else "settings of a part"


def _words(bounds: msgspec.Meta) -> str:
    """Says in words what bounds allow; those that only keep nonsense out are left out."""
    low, high = bounds.ge, bounds.le
    said = [] if low is None or low <= -_HUGE else [f"from {low:g}"]
    said += [] if bounds.gt is None else [f"above {bounds.gt:g}"]
    said += [] if high is None or high >= _HUGE else [f"to {high:g}"]
    said += [] if bounds.lt is None else [f"below {bounds.lt:g}"]
    return "".join(f" {words}" for words in said)


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "required"
    if isinstance(value, bool):
        return "on" if value else "off"
    if value is None or value == () or value == "":
        return "none"
    if dataclasses.is_dataclass(value) or isinstance(value, Mapping):
        return str(getattr(value, "name", "")) or "see there"
    return f"`{' '.join(map(str, value)) if isinstance(value, tuple) else value}`"


# Metrics


def metrics_of(algorithm: str) -> str:
    """The table of an algorithm's metrics; of a subclass, those that it adds."""
    _, *above = (name for name in family(algorithm) if name)
    inherited = {column for name in above for column in known_columns(name)}
    own = [column for column in known_columns(algorithm) if column not in inherited]
    if above and not own:
        return f"Those of `{above[0]}`.\n"
    lines = [f"Beside those of `{above[0]}`:", ""] if above else []
    lines += ["| column | what it is | healthy | otherwise |", "|---|---|---|---|"]
    for column in own:
        words = words_of(algorithm, column)
        lines.append(f"| `{column}` | {words.what} | {words.healthy} | {words.otherwise} |")
    return "\n".join(lines) + "\n"


def _metrics() -> str:
    names = sorted(_algorithms(), key=lambda name: (name != "ppo", name))
    sections = [f"## `{name}`\n\n{metrics_of(name)}" for name in names]
    return "\n".join(sections)


# Public names


def _index() -> str:
    """Leads to the packages' files; the site leads to their pages instead."""
    lines = ["| package | public names |", "|---|---|"]
    for package, names in public().items():
        file = Path(str(_import(package).__file__)).relative_to(ROOT).as_posix()
        listed = ", ".join(f"`{name}`" for name in sorted(names, key=str.lower))
        lines.append(f"| [{package}](../../{file}): {_summary(package)} | {listed} |")
    return "\n".join(lines) + "\n"


def _api(package: str, names: Iterable[str]) -> str:
    module = _import(package)
    text = [f"# {package}", "", _plain(module.__doc__ or ""), ""]
    for name in sorted(names, key=str.lower):
        target = _target(package, name)
        if package == "torchrl_tit":  # shortcuts, which their own packages explain
            text.append(f"- [`{name}`][{target}]")
            continue
        text += [f"::: {target}", "    options:", f"      heading: {name}", ""]
    return "\n".join(text) + "\n"


def _target(package: str, name: str) -> str:
    """Where griffe, which reads sources and imports nothing, finds a public name."""
    module = _import(package)
    homes: Mapping[str, str] = getattr(module, "_HOMES", {})
    if not homes:
        hidden = (Path(str(module.__file__)).parent / f"{name}.py").exists()  # by a module
        return f"{package}.{name}.{name}" if hidden else f"{package}.{name}"
    home = importlib.import_module(
        homes[name] if homes[name].startswith("torchrl_tit.") else f".{homes[name]}",
        module.__name__,
    )
    return f"{home.__name__}.{name}"


def _import(package: str) -> types.ModuleType:
    return importlib.import_module(package.replace("torchrl_tit.recipes", "recipes"))


def _summary(package: str) -> str:
    return _plain((_import(package).__doc__ or "").strip().split("\n\n")[0]).replace("\n", " ")


def _plain(text: str) -> str:
    """Turns the roles of a docstring into code, and indented lines into a block."""
    text = re.sub(r":\w+:`~?([\w.]+)`", r"`\1`", text)
    return re.sub(
        r"(?:^    .*\n?)+", lambda m: f"```text\n{m[0].rstrip()}\n```\n", text, flags=re.M
    )


if __name__ == "__main__":
    for path, text in pages().items():
        file = ROOT / "docs" / "reference" / path
        if path.startswith("api/"):  # what only mkdocstrings reads
            file = ROOT / "build" / "docs" / "reference" / path
            file.parent.mkdir(parents=True, exist_ok=True)
        else:
            text = fill(file.read_text(encoding="utf-8"), path, text)
        file.write_text(text, encoding="utf-8")
