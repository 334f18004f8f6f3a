"""The tutorials and how-to pages: their code runs in the order of the page, with fewer steps.

What is shortened stands in a comment before the code, which readers do not see; PPO's batches are
smaller, too:

    <!-- test: 30000 -> 512; --step 40 -> --step 3 -->
"""

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
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

SHORT = "--num-envs 8 --steps-per-batch 512 --minibatch-size 256 --epochs 1 --evaluation-episodes 1"


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
    if page.stem == "deploying":
        for package in ("onnxruntime", "onnxscript", "captum"):
            pytest.importorskip(package)
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
                main([*words[3:], *(SHORT.split() if "train ppo/" in command else ())])
    if page.stem == "deploying":
        act_without_torch(own_modules)


def act_without_torch(folder: Path) -> None:
    """Runs the loop of the page on deploying where only ONNX Runtime and NumPy can be imported."""
    shutil.copy(ROOT / "docs" / "examples" / "act_from_onnx.py", folder)
    code = (
        "import runpy, sys\n"
        "missing = ('torch', 'torchrl', 'tensordict', 'torchrl_tit', 'recipes', 'gymnasium')\n"
        "sys.modules.update(dict.fromkeys(missing))\n"  # importing them fails
        "runpy.run_path('loop.py')\n"
    )
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    checksum, facts, latency = done.stdout.splitlines()
    assert checksum == hashlib.sha256((folder / "machine.onnx").read_bytes()).hexdigest()
    assert facts.startswith("bc/enhanced-tit 2 ")
    assert re.fullmatch(r"p50 \d+\.\d\d ms, p99 \d+\.\d\d ms", latency)


def test_no_two_pages_write_one_run():
    """Readers follow them one after the other, in one folder."""
    runs = re.compile(r"(?:train|sweep) [^\n]*--out (runs/\S+)")
    written = [run for page in PAGES for run in {*runs.findall(page.read_text())}]
    assert len(written) > 10
    assert len(written) == len({*written})
