"""What is imported by its name, and what users have allowed."""

import re
import subprocess
import sys

import pytest

from torchrl_tit.settings.imports import (
    allow,
    allowed_modules,
    import_allowed,
    import_module,
    import_options,
    is_named,
    resolve,
)


@pytest.fixture(autouse=True)
def _modules(own_modules):
    """Modules that are not loaded."""
    for name in ("pack_a", "pack_b"):
        (own_modules / name).mkdir()
        (own_modules / name / "__init__.py").touch()
        (own_modules / name / "parts.py").write_text("ANSWER = 42\n")
    (own_modules / "raises_a.py").write_text("raise RuntimeError('two\\nlines')\n")
    (own_modules / "raises_b.py").write_text("import no_such_dependency\n")
    (own_modules / "no_python.py").write_text("x = (\n")
    (own_modules / "json.py").touch()


def test_a_module_is_allowed_with_those_below_it():
    assert not is_named("pack_a.parts")
    allow("pack_a")
    assert is_named("pack_a.parts")
    assert resolve("pack_a.parts:ANSWER") == 42  # found in the current directory
    allow("pack_b.parts")
    assert is_named("pack_b.parts")
    assert not is_named("pack_b")  # only a part of it
    allow("pack_a")
    assert allowed_modules() == ["pack_a", "pack_b.parts"]
    assert import_options() == ["--import", "pack_a", "--import", "pack_b.parts"]


def test_a_name_that_only_begins_alike_is_not_allowed():
    allow("pack")
    assert not is_named("pack_a")


def test_a_file_is_imported_under_its_own_name_with_its_neighbors(own_modules):
    (own_modules / "pack_a" / "mine.py").write_text("from parts import ANSWER\n")
    module = import_allowed("pack_a/mine.py")
    assert (module.__name__, module.ANSWER) == ("mine", 42)
    assert import_allowed("pack_a/mine.py") is module  # it runs once
    assert resolve("mine:ANSWER") == 42
    assert allowed_modules() == ["pack_a/mine.py"]
    allow("mine")  # as in `--import pack_a/mine.py --wrappers mine:Wrapper`
    assert allowed_modules() == ["pack_a/mine.py"]


def test_processes_that_are_started_later_know_what_is_allowed():
    allow("pack_a")
    program = "from torchrl_tit.settings.imports import is_named; print(is_named('pack_a.parts'))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "True\n", done.stderr


@pytest.mark.parametrize(
    ("use", "error", "message"),
    [
        (lambda: resolve("math:no"), ImportError, "math has no 'no', which 'math:no' names"),
        (lambda: allow("a-b"), ValueError, "'a-b' is not the name of a module"),
        (lambda: allow("a-b.py"), ValueError, "'a-b.py' is not the name of a module"),
        (lambda: import_allowed("none.py"), ImportError, "^there is no file none.py$"),
        (
            lambda: import_allowed("json.py"),
            ValueError,
            r"^json.py has the name of another module, json \(.*\): rename it$",
        ),
        (
            lambda: import_allowed("no_python.py"),
            ImportError,
            r"no_python.py is not Python: .* \(line 1\)$",
        ),
        (lambda: import_allowed("nowhere.x"), ImportError, "^there is no module 'nowhere', looked"),
        (lambda: import_allowed("pack_a.x"), ImportError, r"^there is no module 'pack_a\.x', look"),
        (
            lambda: import_allowed("raises_a"),
            ImportError,
            re.escape("module 'raises_a' cannot be imported: RuntimeError: two"),
        ),
        (
            lambda: import_module("raises_b"),
            ImportError,
            "^module 'raises_b' cannot be imported: ModuleNotFoundError: .*'no_such_dependency'",
        ),
    ],
)
def test_errors(use, error, message):
    sys.path.insert(0, "")
    with pytest.raises(error, match=message):
        use()
