"""The package of docs/extending.md: it is installed, and the commands of the page run."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from recipes.cli import main
from recipes.core.metrics import read_metrics
from recipes.core.recipe_json import recipe_from_json

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "docs" / "examples" / "own_package"
PAGE = (ROOT / "docs" / "extending.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture
def installed(own_modules: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package, copied by `examples` and installed by pip into a folder of its own."""
    main(["examples", "examples"])
    [words] = [c for block in blocks("sh") for c in block.splitlines() if c.startswith("pip ")]
    site = own_modules / "site"
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(site)]
    command = [sys.executable, "-m", *shlex.split(words), *offline, "--disable-pip-version-check"]
    subprocess.run(command, cwd=own_modules, check=True, capture_output=True)
    sys.path.append(str(site))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(site)]))
    return site


def without_layout(code: str) -> str:
    """Code without indentation and empty lines: the page's methods stand alone."""
    return "\n".join(line.strip() for line in code.splitlines() if line.strip())


def test_the_page_quotes_the_files():
    code = without_layout((PACKAGE / "own_package.py").read_text())
    assert blocks("py")
    for block in blocks("py"):
        assert without_layout(block) in code
    [toml] = blocks("toml")
    assert toml in (PACKAGE / "pyproject.toml").read_text()


def test_commands_of_the_page(installed, own_modules, capsys):
    [source] = [block for block in blocks("python") if "small = " in block]
    (own_modules / "my_recipes.py").write_text(source)
    lines = "".join(blocks("sh")).replace("\\\n", "").splitlines()
    lines = [line.removeprefix("torchrl-tit ") for line in lines]
    commands = [line for line in lines if not line.startswith(("pip", "examples"))]
    printed = {}
    for command in commands:
        if not command.startswith("sweep"):  # see below
            main(shlex.split(command))
            printed[command] = capsys.readouterr().out
    assert printed["list own"] == "own/line\n"
    assert "is complete" in printed["train --resume runs/line"]

    runs = own_modules / "runs"
    assert [row["step"] for row in read_metrics(runs / "line" / "metrics.csv")] == [512, 1024]
    evaluations = {"evaluation.json": 20, "evaluation_episodes-5.json": 5}
    for name, episodes in evaluations.items():
        assert json.loads((runs / "line" / name).read_text())["episodes"] == episodes
    assert (runs / "line.gif").read_bytes().startswith(b"GIF")
    [data] = [command for command in commands if command.startswith("data")]
    assert printed[data].startswith("medium: 1")  # 100 transitions and the rest of an episode
    fields = json.loads((runs / "linear" / "recipe.json").read_text())["backbone"]
    assert (fields["frame"]["encoder"], fields["history"]["encoder"]) == ("linear", "recency")
    fields = json.loads((runs / "fourier" / "recipe.json").read_text())["backbone"]
    assert fields["frame"] == {"encoder": "fourier", "num_frequencies": 4, "embed_dim": 32}
    shown = recipe_from_json(printed["show my_recipes.py:small"], "what show printed")
    assert shown.name == "ppo/cartpole/small"


@pytest.mark.slow
def test_processes_of_a_sweep_know_the_package(installed, own_modules, capsys):
    [command] = re.findall(r"torchrl-tit (sweep own.*)", PAGE)
    main(shlex.split(command))
    folder = own_modules / "runs" / "sweep" / "own" / "line"
    seeds = [json.loads((folder / f"seed-{i}" / "recipe.json").read_text())["seed"] for i in (0, 1)]
    assert seeds == [0, 1]
    assert "2 runs are complete" in capsys.readouterr().out
