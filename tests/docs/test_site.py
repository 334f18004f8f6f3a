"""The documentation site, as far as it can be told without what builds it."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from docs.tools import reference
from recipes.cli.main import COMMANDS
from recipes.core.recipe import Recipe
from recipes.core.registry import RECIPES
from torchrl_tit.settings import FrameSettings, HistorySettings

ROOT = Path(__file__).parents[2]


def listed(nav) -> Iterator[str]:
    """Every page of the navigation."""
    for entry in nav if isinstance(nav, list) else nav.values():
        if isinstance(entry, str):
            yield entry
        else:
            yield from listed(entry)


def test_every_page_is_in_the_navigation():
    pages = [*listed(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])]
    written = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    public = {f"reference/api/{package}.md" for package in reference.public()}
    assert len(set(pages)) == len(pages)
    linked = {page for page in written if page.startswith("results/") and page.count("/") > 1}
    named = {page for page in pages if not page.startswith("source/")}
    assert named | linked == written | public


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return reference.pages()


def test_the_pages_that_follow_from_the_code_are_complete_in_a_checkout(pages):
    for name in pages:
        if "/" not in name:  # those of packages are pages of their own
            page = (ROOT / "docs" / "reference" / name).read_text()
            written = reference.fill(page, name, pages[name])
            # Pythons differ in where they break the lines of a help.
            assert page.split() == written.split(), "run python -m docs.tools.reference"


def test_commands(pages):
    for command in COMMANDS:
        assert f"\n## {command}" in pages["commands.md"]
    assert "usage: python -m recipes data collect" in pages["commands.md"]
    assert pages["commands.md"].count("usage: ") == len(COMMANDS) + 2  # data has three
    assert "--backbone" not in pages["commands.md"]


def test_metrics(pages):
    algorithms = {recipe.algorithm for recipe in RECIPES.values()}
    assert {*re.findall(r"^## `(.*)`$", pages["metrics.md"], flags=re.MULTILINE)} == algorithms
    of_ppo = [name for name in algorithms if name.startswith("ppo-")]  # only what they add
    assert pages["metrics.md"].count("| `return_mean` |") == len(algorithms) - len(of_ppo)


def test_fields(pages):
    assert {recipe.algorithm for recipe in RECIPES.values()} <= {*Recipe.registered}
    lines = pages["fields.md"].splitlines()
    tables = [Recipe.registered, FrameSettings.registered, HistorySettings.registered]
    for kind in [kind for table in tables for kind in table.values()]:
        if kind.__module__.startswith(("recipes.", "torchrl_tit.")):
            anchor = kind.__name__.lower()
            assert {f'<a id="{anchor}"></a>', f"## `{anchor}`"} & {*lines}, kind
            for field in dataclasses.fields(kind):
                if field.name != "name":
                    assert any(line.startswith(f"| `{field.name}` |") for line in lines), field
    for line in lines:
        if line.startswith("| `"):
            assert len(line.split(" | ")[3]) > 10, f"no words about {line}"


def test_every_public_name_is_documented(pages):
    for package, names in reference.public().items():
        for name in names:
            text = pages[f"api/{package}.md"]
            assert f"heading: {name}\n" in text or f"[`{name}`]" in text
