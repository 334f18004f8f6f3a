"""MkDocs' hooks: the same Markdown is read in the repository and on the site.

- Links to the file of a public package lead to its page, which docs/tools/reference.py wrote.
- Links to files outside of docs/, and to source code, lead to pages that show these files.
- Links to folders of results lead to lists of what is in them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from posixpath import dirname, relpath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
WRITTEN = ROOT / "build" / "docs" / "reference"
"""Where `make docs` lets docs/tools/reference.py write."""

_LINK = re.compile(r"(\]\()([^)\s]+)(\))")
_CODE = re.compile(r"^(`{3,}).*?^\1`*$", re.MULTILINE | re.DOTALL)
_LANGUAGES = {".py": "python", ".toml": "toml", ".txt": "text", ".json": "json", ".cff": "yaml"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that have no file in docs/."""
    for path in sorted(WRITTEN.glob("api/*.md")):
        uri = f"reference/api/{path.name}"
        files.append(File.generated(config, uri, content=path.read_text(encoding="utf-8")))
    pages = [DOCS / file.src_uri for file in files.documentation_pages() if file.abs_src_path]
    waiting = [ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
    waiting += [target for page in pages for target in _outside(page)]
    shown: set[Path] = set()
    while waiting:
        target = waiting.pop()
        if target not in shown:
            shown.add(target)
            files.append(File.generated(config, _uri(target), content=_show(target)))
            waiting += _outside(target) if target.suffix == ".md" else []
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Mends the links."""
    uri = page.file.src_uri
    here = DOCS / uri if page.file.abs_src_path else None
    if uri.startswith("source/") and uri.endswith(".md.md"):
        here = ROOT / uri.removeprefix("source/").removesuffix(".md")
    return markdown if here is None else _mend(markdown, here, uri)


def _mend(markdown: str, here: Path, uri: str) -> str:
    """Makes the links of a file of the repository lead to pages of the site."""

    def mend(link: re.Match[str]) -> str:
        path, hash_, anchor = link[2].partition("#")
        target = _resolve(here, path)
        if target is None:
            return link[0]
        return f"{link[1]}{relpath(_uri(target), dirname(uri) or '.')}{hash_}{anchor}{link[3]}"

    return _outside_code(markdown, lambda text: _LINK.sub(mend, text))


def _outside_code(markdown: str, change: Callable[[str], str]) -> str:
    """Changes what does not stand in fenced code."""
    parts, end = [], 0
    for code in _CODE.finditer(markdown):
        parts += [change(markdown[end : code.start()]), code[0]]
        end = code.end()
    return "".join([*parts, change(markdown[end:])])


def _outside(file: Path) -> Iterator[Path]:
    """What a Markdown file links to that is no page of its own."""
    text = _CODE.sub("", file.read_text(encoding="utf-8"))
    for _, link, _ in _LINK.findall(text):
        target = _resolve(file, link.partition("#")[0])
        if target is not None and _uri(target).startswith("source/"):
            yield target


def _resolve(here: Path, link: str) -> Path | None:
    """The file or folder of the repository that a link leads to; None if it is another kind."""
    if not link or re.match(r"[a-z]+:", link):
        return None
    target = Path(os.path.normpath(here.parent / link))
    return target if target.exists() else None


def _uri(target: Path) -> str:
    """Where the site has a file of the repository, as the path of a Markdown source."""
    name = target.relative_to(ROOT).as_posix()
    if name == "README.md":
        return "index.md"
    module = name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    for package in (module, f"torchrl_tit.{module}"):  # recipes have another name in the wheel
        if (WRITTEN / "api" / f"{package}.md").exists():
            return f"reference/api/{package}.md"
    in_docs = name.startswith("docs/") and target.is_file()
    if in_docs and target.suffix not in (".py", ".toml"):
        return name.removeprefix("docs/")
    return f"source/{name}.md"


def _entry(path: Path, folder: Path) -> str:
    """A line about a file of a folder; the site has those of docs/, to be downloaded."""
    name = path.relative_to(folder).as_posix()
    if not path.is_relative_to(DOCS):
        return f"`{name}`"
    up = "../" * len(folder.relative_to(ROOT).parts)
    return f"[{name}]({up}{path.relative_to(DOCS).as_posix()})"


def _show(target: Path) -> str:
    """A page with a file's text, or with a list of a folder's files."""
    name = target.relative_to(ROOT).as_posix()
    if target.suffix == ".md":
        return target.read_text(encoding="utf-8")
    if target.is_dir():
        files = sorted(path for path in target.rglob("*") if path.is_file())
        files = [path for path in files if "__pycache__" not in path.parts]
        rows = [f"- {_entry(path, target)}" for path in files]
        return "\n".join([f"# `{name}`", "", *rows, ""])
    language = _LANGUAGES.get(target.suffix, "text")
    return f"# `{name}`\n\n```{language}\n{target.read_text(encoding='utf-8')}\n```\n"
