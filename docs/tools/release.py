"""Checks what `make release` has built: ``python -m docs.tools.release FOLDER --pythons ...``.

Each Python makes a clean environment and installs the wheel there as a user does. In an empty
folder it then plays a trained agent, copies the examples, and runs the Python of the README; with
``--suite`` it also runs the tests of the sdist. A Python that is not there is named and skipped.
The release's notes, the version's section of the changelog, are written to FOLDER/notes.md.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from torchrl_tit.files import write_text_atomic

ROOT = Path(__file__).parents[2]


def notes(changelog: str, version: str) -> str:
    """Returns the section of a version in a changelog, without its heading.

    Raises:
        ValueError: if there is none.
    """
    found = re.search(
        rf"^## \[{re.escape(version)}\].*?$\n(.*?)(?=^## \[|\Z)",
        changelog,
        re.DOTALL | re.MULTILINE,
    )
    if found is None:
        raise ValueError(f"the changelog has no section [{version}]: add one")
    return found[1].strip() + "\n"


def python_of(document: str) -> str:
    """Returns the Python blocks of a page, as one program."""
    return "\n".join(re.findall(r"```python\n(.*?)```", document, flags=re.DOTALL))


def why_not(python: str) -> str:
    """Says why an interpreter cannot be used; empty if it can."""
    if shutil.which(python) is None:
        return "there is no such program"
    command = [python, "-c", "import ensurepip, venv"]
    result = subprocess.run(command, capture_output=True, text=True)
    return " ".join(result.stderr.split()) if result.returncode else ""


def check(python: str, wheel: Path, sdist: Path, suite: bool) -> None:
    """Installs the wheel in a clean environment and uses it.

    Raises:
        subprocess.CalledProcessError: if a step fails; its output was shown.
    """
    with tempfile.TemporaryDirectory() as folder:
        bin_, empty = Path(folder, "venv", "bin"), Path(folder, "empty")
        empty.mkdir()

        def run(*words: object, cwd: Path = empty) -> None:
            print(f"{python}: {' '.join(Path(str(word)).name for word in words)}", flush=True)
            clean = {name: os.environ[name] for name in os.environ if name != "PYTHONPATH"}
            subprocess.run([str(word) for word in words], cwd=cwd, env=clean, check=True)

        run(python, "-m", "venv", Path(folder, "venv"))
        run(bin_ / "python", "-m", "pip", "install", "--quiet", wheel)
        run(bin_ / "torchrl-tit", "play", "cartpole", "--episodes", "2")
        run(bin_ / "torchrl-tit", "examples", "examples")
        (empty / "readme.py").write_text(python_of((ROOT / "README.md").read_text("utf-8")))
        run(bin_ / "python", "readme.py")
        if suite:
            with tarfile.open(sdist) as tar:
                tar.extractall(folder, filter="data")
            source = Path(folder, sdist.name.removesuffix(".tar.gz"))
            pins = ("-c", source / "constraints.txt")
            run(bin_ / "python", "-m", "pip", "install", "--quiet", *pins, f"{source}[test]")
            run(bin_ / "python", "-m", "pytest", "-q", "-m", "not slow", "-n", "2", cwd=source)


def main(arguments: list[str] | None = None) -> None:
    """Writes the notes, checks the files with each Python, and says what was left out."""
    parser = argparse.ArgumentParser("python -m docs.tools.release")
    parser.add_argument("folder", type=Path, help="folder of one wheel and its sdist")
    parser.add_argument("--pythons", nargs="+", required=True, help="interpreters to check with")
    parser.add_argument("--suite", action="store_true", help="also run the tests of the sdist")
    options = parser.parse_args(arguments)
    [wheel], [sdist] = options.folder.glob("*.whl"), options.folder.glob("*.tar.gz")
    version = wheel.name.split("-")[1]
    changelog = (ROOT / "CHANGELOG.md").read_text("utf-8")
    write_text_atomic(options.folder / "notes.md", notes(changelog, version))
    skipped = [] if options.suite else ["the tests of the sdist: SUITE=--suite runs them"]
    if not os.environ.get("PROJECT_URL"):
        skipped.append("addresses in the wheel, and absolute links: URL=https://... gives them")
    if f"[{version}] - unreleased" in changelog:
        skipped.append(f"the date of {version}: the changelog calls it unreleased")
    checked = []
    for python in options.pythons:
        if reason := why_not(python):
            skipped.append(f"{python}: {reason}")
            continue
        check(python, wheel.absolute(), sdist.absolute(), options.suite)
        checked.append(python)
    for line in skipped:
        print(f"skipped: {line}")
    if not checked:
        sys.exit(f"error: none of {', '.join(options.pythons)} can be used: name others as PYTHONS")
    print(f"{wheel.name} works with {', '.join(checked)}; to be published: {options.folder}")


if __name__ == "__main__":
    main()
