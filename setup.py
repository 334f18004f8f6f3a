"""What pyproject.toml cannot say: which packages the wheel carries, and where the project lives.

`recipes` is a top-level folder of a clone. A wheel that put a top-level package of so common a name
into site-packages would clash with others, so it is installed as `torchrl_tit.recipes`.

The address of the repository is that of whoever publishes it, in the variable PROJECT_URL, which
`make release` sets. With it, the wheel names the pages, and the links of its README are absolute.
"""

import os
import re
import tomllib
from pathlib import Path

from setuptools import find_packages, setup

ADDRESS = os.environ.get("PROJECT_URL", "").rstrip("/")
TAG = f"v{tomllib.loads(Path('pyproject.toml').read_text())['project']['version']}"


def absolute(link: re.Match[str]) -> str:
    """A link of the README to a file of the repository, at the tag of this version."""
    kind = "raw" if link[1].endswith((".png", ".gif")) else "blob"
    return f"]({ADDRESS}/{kind}/{TAG}/{link[1]})"


readme = Path("README.md").read_text(encoding="utf-8")
urls = {"Paper": "https://arxiv.org/abs/2212.14538"}
if ADDRESS:
    readme = re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)\)", absolute, readme)
    urls |= {
        "Homepage": ADDRESS,
        "Documentation": f"{ADDRESS}/blob/{TAG}/docs/index.md",
        "Changelog": f"{ADDRESS}/blob/{TAG}/CHANGELOG.md",
        "Issues": f"{ADDRESS}/issues",
    }

library = find_packages(include=["torchrl_tit", "torchrl_tit.*"])
recipes = find_packages(include=["recipes", "recipes.*"])

setup(
    long_description=readme,
    long_description_content_type="text/markdown",
    project_urls=urls,
    packages=[*library, *(f"torchrl_tit.{name}" for name in recipes), "torchrl_tit.examples"],
    package_dir={"torchrl_tit.recipes": "recipes", "torchrl_tit.examples": "docs/examples"},
    package_data={
        "torchrl_tit": ["py.typed"],
        "torchrl_tit.agents": ["*/*.json", "*/*.md", "*/*.safetensors"],
        "torchrl_tit.examples": ["own_package/*.py", "own_package/*.toml"],
        "torchrl_tit.recipes": [
            "tools/*/*.csv",
            "tools/*/*.html",
            "tools/*/*.json",
            "tools/*/*.md",
        ],
    },
)
