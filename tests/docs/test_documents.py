"""The documents: their links lead somewhere, and their Python runs."""

import re
from pathlib import Path

import pytest

from recipes.core import registry
from recipes.tools.results.experiments import find_runs
from torchrl_tit.settings import FrameSettings, HistorySettings

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
# With their commands in test_tutorials.py, and README.md without extras in tests/test_extras.py.
RUN_ELSEWHERE = ("tutorials", "how-to", ROOT.name)


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
def test_links_lead_somewhere(document):
    text = re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not re.match(r"[a-z]+:", target):
            path = document.parent / target.split("#")[0]
            assert path.exists(), f"{name(document)} links to {target}"


@pytest.mark.parametrize(
    "document",
    [d for d in DOCUMENTS if "```python" in d.read_text() and d.parent.name not in RUN_ELSEWHERE],
    ids=name,
)
def test_python_runs(document):
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", document.read_text(), flags=re.DOTALL):
        exec(compile(block, name(document), "exec"), namespace)


def test_all_pages_together_are_short():
    """What was written from the code is as long as the code makes it."""
    pages = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    written = re.compile(r"<!-- reference: .*?<!-- end -->", re.DOTALL)
    assert sum(len(written.sub("", page.read_text()).split()) for page in pages) <= 45_000


def test_the_page_on_recipes_lists_every_encoder():
    page = (ROOT / "docs" / "recipes.md").read_text()
    for kind, settings in (("frame", FrameSettings), ("history", HistorySettings)):
        [row] = re.findall(rf"^\| `--backbone\.{kind}` \|.*", page, flags=re.MULTILINE)
        classes = settings.registered.items()
        ours = {name for name, c in classes if c.__module__.startswith("torchrl_tit.")}
        assert {*re.findall(r"`([\w-]+)`", row)} == ours


def test_results_can_be_run_again():
    assert registry.RECIPES  # every algorithm that a recipe can name is registered
    assert len(find_runs([ROOT / "docs/results"])) > 600


def test_results_are_few_files():
    """Runs are rows of tables, and what a page says is checked in them."""
    files = [path for path in (ROOT / "docs/results").rglob("*") if path.is_file()]
    assert len(files) <= 150
    assert sum(path.stat().st_size for path in files) <= 6_000_000
