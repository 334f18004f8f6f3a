"""The tutorials and how-to pages: their code runs in the order of the page, with fewer steps.

What is shortened stands in a comment before the code, which readers do not see:

    <!-- test: 30000 -> 1024; --step 40 -> --step 3 -->
"""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from recipes.cli import main

ROOT = Path(__file__).parents[2]
PAGES = [
    page
    for folder in ("tutorials", "how-to")
    for page in sorted((ROOT / "docs" / folder).glob("*.md"))
    if page.name != "index.md"
]
BLOCK = re.compile(
    r"(?:<!-- test: ([^\n]*) -->\n)?```(\w+)(?: title=\"([^\n]*)\")?\n(.*?)```", re.DOTALL
)


def blocks(page: Path) -> Iterator[tuple[str, str, str]]:
    """Language, file name and code of each block that runs, shortened."""
    for changes, language, title, code in BLOCK.findall(page.read_text()):
        for change in filter(None, changes.split("; ")):
            long, short = change.split(" -> ")
            assert long in code, f"{page.name} has no {long!r} to shorten"
            code = code.replace(long, short)
        if language in ("python", "sh"):
            yield language, title, code


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_runs(page, own_modules, monkeypatch):
    monkeypatch.syspath_prepend(str(own_modules))
    namespace: dict[str, object] = {"__name__": "__main__"}
    for language, title, code in blocks(page):
        if title:
            (own_modules / title).write_text(code)
        elif language == "python":
            exec(compile(code, page.name, "exec"), namespace)
        else:
            for command in code.splitlines():
                words = shlex.split(command)
                assert words[:3] == ["python", "-m", "recipes"], command
                main(words[3:])


def test_what_is_shown_and_not_run_is_a_command():
    for page in PAGES:
        for _, language, _, code in BLOCK.findall(page.read_text()):
            assert language in ("python", "sh", "bash"), page.name
            assert code.strip(), page.name
