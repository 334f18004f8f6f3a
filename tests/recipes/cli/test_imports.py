"""Listing and help do not import PyTorch, whose import takes seconds."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SLOW = ("torch", "torchrl", "tensordict", "gymnasium", "matplotlib", "scipy", "optuna", "ray")


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["list"],
        ["evaluate", "--help"],
    ],
    ids=" ".join,
)
def test_no_slow_import(words):
    program = f"""
import sys
from recipes.cli import main
try:
    main({words!r})
except SystemExit as stop:
    assert not stop.code, stop.code
print(*(name for name in {SLOW!r} if name in sys.modules), file=sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout
    assert done.stderr == "\n"


def test_the_library_and_its_settings_are_imported_without_pytorch():
    program = "import sys, torchrl_tit, torchrl_tit.settings; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
