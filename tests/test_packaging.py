"""What is built from the project: the wheel, its metadata, and the files that repeat them."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import NormalizedName, canonicalize_name

from torchrl_tit.extras import EXTRAS

ROOT = Path(__file__).parents[1]
ADDRESS = "https://example.org/torchrl-tit"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the sdist, built from a copy, so that the clone stays clean."""
    source = tmp_path_factory.mktemp("source") / "project"
    outdir = tmp_path_factory.mktemp("dist")
    unpublished = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "runs")
    shutil.copytree(ROOT, source, ignore=unpublished)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(outdir)]
    env = os.environ | {"PROJECT_URL": ADDRESS}
    result = subprocess.run(command, cwd=source, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert len(list(outdir.glob("*.tar.gz"))) == 1
    [path] = outdir.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as archive:
        [name] = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def test_wheel_holds_every_module_once_and_nothing_beside_the_library(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        names = {n for n in archive.namelist() if ".dist-info/" not in n}
    library = {
        p.relative_to(ROOT).as_posix()
        for p in (ROOT / "torchrl_tit").rglob("*")
        if p.suffix in (".py", ".pyi")
    }
    agents = {
        p.relative_to(ROOT).as_posix()
        for p in (ROOT / "torchrl_tit" / "agents").glob("*/*")
        if p.parent.name != "__pycache__"
    }
    recipes = {
        p.relative_to(ROOT).as_posix()
        for p in (ROOT / "recipes").rglob("*")
        # With the paper's results, search spaces, and the page of reports.
        if p.suffix in (".py", ".csv", ".json", ".html", ".md")
    }

    assert "torchrl_tit/agents/cartpole/model.safetensors" in agents
    examples = {
        p.relative_to(ROOT / "docs").as_posix()
        for p in (ROOT / "docs" / "examples").rglob("*")
        if p.suffix in (".py", ".toml")
    }

    assert "examples/own_package/pyproject.toml" in examples
    library |= agents | {"torchrl_tit/py.typed"}
    assert names == library | {f"torchrl_tit/{n}" for n in recipes | examples}


def test_installed_wheel_starts_the_command_without_a_top_level_recipes(
    wheel: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    with ZipFile(wheel) as archive:
        archive.extractall(site)
    # As the script that pip writes: the entry point of the wheel's metadata, loaded and called.
    program = """
import importlib.util, pathlib, sys
from importlib.metadata import distributions

site = sys.argv[1]
sys.path.insert(0, site)
assert importlib.util.find_spec("recipes") is None
[distribution] = distributions(name="torchrl-tit", path=[site])
[script] = distribution.entry_points.select(group="console_scripts")
main = script.load()
assert pathlib.Path(sys.modules[main.__module__].__file__).is_relative_to(site), main
sys.argv = [script.name, "list"]
sys.exit(main())
"""
    result = subprocess.run(
        [sys.executable, "-c", program, str(site)], cwd=tmp_path, capture_output=True, text=True
    )

    assert result.returncode == 0, result.stderr
    assert "ppo/cartpole/enhanced-tit" in result.stdout


def test_metadata_names_license_python_and_readme(metadata: Message) -> None:
    assert metadata["Name"] == "torchrl-tit"
    assert metadata["License-Expression"] == "MIT"
    assert metadata["License-File"] == "LICENSE"
    assert metadata["Requires-Python"] == ">=3.11"


def test_links_of_the_description_hold_outside_of_the_repository(metadata: Message) -> None:
    urls = dict(text.split(", ") for text in metadata.get_all("Project-URL", []))
    assert urls.keys() == {"Paper", "Homepage", "Documentation", "Changelog", "Issues"}
    page, readme = str(metadata.get_payload()), (ROOT / "README.md").read_text()
    links = re.findall(r"\]\((.*?)\)", page)
    assert len(links) == len(re.findall(r"\]\((.*?)\)", readme))
    assert all(link.startswith("https://") for link in links)
    tag = f"v{PROJECT['version']}"
    local = [link for link in [*links, *urls.values()] if f"/{tag}/" in link]
    assert len(local) > 10
    for link in local:
        match = re.fullmatch(rf"{ADDRESS}/(raw|blob)/{tag}/(.*)", link)
        assert match is not None, link
        assert (ROOT / match[2].partition("#")[0]).exists(), link
        assert (match[1] == "raw") == link.endswith((".png", ".gif"))
    assert re.sub(r"\]\(.*?\)", "", page) == re.sub(r"\]\(.*?\)", "", readme)


def test_version_is_the_same_everywhere(metadata: Message) -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest = re.search(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)

    assert newest is not None
    assert {metadata["Version"], citation["version"], newest[1]} == {PROJECT["version"]}


def test_every_direct_dependency_is_pinned_within_its_range() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    versions = {canonicalize_name(name): version for name, version in pins.items()}
    direct = _direct_dependencies()

    assert versions.keys() == direct.keys()
    outside = {n: v for n, v in versions.items() if v not in direct[n].specifier}
    assert not outside


@pytest.mark.parametrize("folder", ["recipes", "torchrl_tit"])
def test_every_imported_distribution_is_a_direct_dependency(folder: str) -> None:
    known = {canonicalize_name(n) for n in sys.stdlib_module_names | {"torchrl_tit"}}
    known |= _direct_dependencies().keys()
    imported = {(p, name.partition(".")[0]) for p, name in _absolute_imports(folder)}

    assert [(p, name) for p, name in imported if canonicalize_name(name) not in known] == []


@pytest.mark.parametrize("folder", ["recipes", "torchrl_tit"])
def test_no_module_imports_recipes_by_its_name_in_a_clone(folder: str) -> None:
    """In the wheel they have another name: they import themselves relatively, the library never."""
    names = re.compile(r"(torchrl_tit\.)?recipes\b")

    assert [(p, name) for p, name in _absolute_imports(folder) if names.match(name)] == []


def test_every_package_of_an_extra_is_known_by_it() -> None:
    extras = {
        name: {canonicalize_name(Requirement(r).name) for r in requirements}
        for name, requirements in PROJECT["optional-dependencies"].items()
    }
    assert {p: e for p, e in EXTRAS.items() if canonicalize_name(p) not in extras[e]} == {}

    required = {canonicalize_name(Requirement(r).name) for r in PROJECT["dependencies"]}
    imports = [*_absolute_imports("recipes"), *_absolute_imports("torchrl_tit")]
    imported = {name.partition(".")[0] for _, name in imports} - sys.stdlib_module_names
    optional = {p for p in imported if canonicalize_name(p) not in {*required, "torchrl-tit"}}
    assert optional - EXTRAS.keys() == set()


def _direct_dependencies() -> dict[NormalizedName, Requirement]:
    extras = PROJECT["optional-dependencies"].values()
    requirements = map(Requirement, sum(extras, PROJECT["dependencies"]))
    return {canonicalize_name(r.name): r for r in requirements if r.name != PROJECT["name"]}


def _absolute_imports(folder: str) -> list[tuple[str, str]]:
    """(file, full name of what it imports) for all modules under a folder of the project."""
    found = []
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            found += [(path.relative_to(ROOT).as_posix(), name) for name in names]
    return found
