"""docs/paper.md has every cell of the paper, with a result or "not run", and recipes that exist."""

import re
from pathlib import Path

import pytest

from docs.tools import paper
from recipes.core.registry import RECIPES
from recipes.tools.results.paper import hyperparameters, paper_cells

PAGE = (Path(__file__).parents[2] / "docs" / "paper.md").read_text()
RESULT = r"\[-?[\d.]+(±[\d.]+)?\]\(results/[\w/.]+\) \(\d+x\d+[kM]\)"
WHERE = {"1": "1", "2": "2", "3": "3", "10": "3", "4": "4", "11": "4"}
"""The table of the page that has a table of the paper."""


def grid(table: str) -> dict[tuple[str, str], str]:
    """The cells of a table of the page, by their row and column, both with their recipe."""
    [printed] = re.findall(rf"<!-- table: paper/{table}\n-->\n(.*?)<!-- end -->", PAGE, re.DOTALL)
    head, _, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in printed.splitlines()
    )
    return {(row[0], name): cell for row in rows for name, cell in zip(head, row, strict=True)}


def plain(head: str) -> str:
    """The head of a row or column as in the paper: without a recipe."""
    return re.split(":| `", head)[0]


@pytest.mark.parametrize("table", WHERE)
def test_every_cell_has_the_papers_number_and_a_result_or_not_run(table):
    cells = grid(WHERE[table])
    expected = [cell for cell in paper_cells() if table in cell.tables]
    counts = {"1": 36, "2": 36, "3": 36, "10": 12, "4": 10, "11": 20}
    assert len(expected) == counts[table]
    for cell in expected:
        axes = (cell.task, cell.network) if WHERE[table] == "3" else (cell.network, cell.task)
        [(heads, text)] = [
            (heads, text) for heads, text in cells.items() if tuple(map(plain, heads)) == axes
        ]
        number, *ours = text.split("<br>")
        assert number.partition(" (curves")[0] == str(cell).replace(" ", "")
        own = [line for line in ours if not line.startswith("near ")]
        own += re.findall("not run", " ".join(heads))
        assert bool(cell.recipes) == bool(ours)
        assert own, f"{cell} has neither a result nor {paper.NOT_RUN}"
        assert all(re.fullmatch(rf"((code|paper|near):? )?({RESULT}|\*open\*)", x) for x in ours)


def test_every_recipe_that_the_page_names_exists():
    names = set(re.findall(r"\b(?:ppo|cql|dt)/[\w.-]+/[\w.-]+", PAGE))
    data = {cell.task for cell in paper_cells() if "3" in cell.tables}
    full = {name.replace("DATA", one) for name in names for one in data if "TASK" not in name}
    assert len(full) > 20
    assert {name for name in full if "GAME" not in name} <= set(RECIPES)
    assert {name for cell in paper_cells() for name in cell.recipes} <= set(RECIPES)


@pytest.mark.parametrize("table", ["5", "6", "7", "9"])
def test_hyperparameters_are_the_papers(table):
    rows = [row for row in hyperparameters(table) if row.name]
    assert len(rows) == 11
    for row in rows:
        line = next(line for line in PAGE.splitlines() if line.startswith(f"| {row.name} |"))
        cell = line.split(" | ")[["5", "6", "7", "9"].index(table) + 1]
        values, differ, ours = cell.strip(" |").partition(" / ")
        assert values == ", ".join(row.values)
        assert bool(differ) == bool(ours)


def test_a_new_run_fills_its_cell(monkeypatch):
    cell = next(c for c in paper_cells() if "ppo/mountaincar/enhanced-tit-paper" in c.recipes)
    recipe = paper.get_recipe("ppo/mountaincar/enhanced-tit-paper")
    found = paper.Measured(
        paper.Match(cell, ""), recipe, "results/classic_control.md", (-90.0, -100.0), 100_352
    )
    monkeypatch.setattr(paper, "measured", lambda: {cell: [found]})
    assert paper.ours(cell) == [
        "code: *open*",
        "paper: [-95±7](results/classic_control.md) (2x100k)",
    ]
    near = paper.Measured(
        paper.Match(cell, "epochs 4"), recipe, "results/pong/records.csv", (-90.0,), 2_000_000
    )
    monkeypatch.setattr(paper, "measured", lambda: {cell: [near]})
    assert paper.ours(cell) == ["*open*", "near [-90](results/pong/records.csv) (1x2M)"]
