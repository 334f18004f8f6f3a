"""What docs/api-stability.md lists exists."""

import importlib
import re
from pathlib import Path

import pytest

import recipes
from torchrl_tit import frames, histories, settings
from torchrl_tit.settings.imports import GROUP

PAGE = (Path(__file__).parents[2] / "docs" / "api-stability.md").read_text()
PACKAGES = re.findall(r"^- `([\w.]+)`$", PAGE, flags=re.MULTILINE)


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_exists_and_is_explained(name):
    # In a clone, the experiments are a top-level package.
    module = importlib.import_module(name.replace("torchrl_tit.recipes", "recipes"))
    assert module.__doc__
    assert len(set(module.__all__)) == len(module.__all__)
    for public in module.__all__:
        value = getattr(module, public)
        if isinstance(value, type) or hasattr(value, "__code__"):
            assert value.__doc__, public


def test_every_package_with_public_names_is_listed():
    library = Path(settings.__file__).parents[1]
    assert {f"torchrl_tit.{path.parent.name}" for path in library.glob("*/__init__.py")} == {
        *PACKAGES
    } - {"torchrl_tit", "torchrl_tit.recipes"}


def test_what_plugins_build_on_is_public():
    [row] = [line for line in PAGE.splitlines() if line.startswith("| Plugins")]
    names = re.findall(r"`([A-Z]\w+)`", row)
    public = {*recipes.__all__, *frames.__all__, *histories.__all__, *settings.__all__}
    assert len(names) == 10
    assert set(names) <= public
    assert f"`{GROUP}`" in row
