"""Names that packages of users' own register, through entry points and by import."""

import sys
from dataclasses import dataclass
from typing import Any

import pytest

from torchrl_tit.settings import FrameSettings
from torchrl_tit.settings.imports import import_allowed, load_plugins

PART = """
from dataclasses import dataclass
from torchrl_tit.settings import FrameSettings

@dataclass(frozen=True, kw_only=True)
class Own(FrameSettings, name="{name}", builds=f"{{__name__}}:Encoder"):
    width: int = 3
"""


@pytest.fixture
def install(own_modules):
    """Installs a package of one module, as pip leaves it."""
    site = own_modules / "site"
    sys.path.append(str(site))

    def write(package, source):
        info = site / f"{package}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[torchrl_tit.plugins]\nparts = {package}\n")
        (site / f"{package}.py").write_text(source)

    return write


def test_a_plugin_is_imported_when_a_name_is_unknown_without_it(install):
    install("wave_a", PART.format(name="wave"))
    FrameSettings.get("inner")
    assert "wave_a" not in sys.modules
    part: Any = FrameSettings.get("wave")
    assert (part().width, part.builds) == (3, "wave_a:Encoder")


def test_two_plugins_with_package_alias_are_named_where_it_is_used(install):
    install("wave_a", PART.format(name="wave"))
    install("wave_b", PART.format(name="wave"))
    install("other_a", PART.format(name="other"))
    message = r"^two frame encoders are called 'wave', in wave_\w.Own and in wave_\w.Own: rename"
    for _ in range(2):
        with pytest.raises(ValueError, match=message) as caught:
            FrameSettings.get("wave")
        assert all(name in str(caught.value) for name in ("wave_a.Own", "wave_b.Own"))
    assert FrameSettings.get("other")  # others work


def test_a_name_of_ours_cannot_be_taken(own_modules):
    (own_modules / "taken.py").write_text(PART.format(name="inner"))
    message = r"'taken' cannot be .*'inner', in torchrl_tit.settings.encoders.Inner and in taken.O"
    with pytest.raises(ImportError, match=message):
        import_allowed("taken")


def test_a_definition_may_be_repeated():
    """As a notebook's cell is run again."""
    home = {"__module__": __name__, "__qualname__": "Again"}
    for width in (1, 2):
        made = type("Again", (FrameSettings,), home | {"w": width}, name="again", builds="a:b")
        assert FrameSettings.get("again") is dataclass(frozen=True)(made)
    assert vars(FrameSettings.get("again"))["w"] == 2
    del FrameSettings.registered["again"]


def test_a_plugin_that_fails_is_named_where_a_name_is_unknown(install):
    install("broken_a", "import no_such_dependency\n")
    install("wave_a", PART.format(name="wave"))
    assert FrameSettings.get("wave")
    failure = (
        "the entry point 'parts' of the package broken_a failed: module 'broken_a' cannot be "
        "imported: ModuleNotFoundError: No module named 'no_such_dependency'"
    )
    with pytest.raises(
        ValueError, match="unknown frame encoder 'wav': did you mean wave"
    ) as caught:
        FrameSettings.get("wav")
    assert str(caught.value).endswith(f"(one of your own needs `--import MODULE`); {failure}")
    assert load_plugins() == [failure]


@pytest.mark.parametrize("name", [None, 3, [], {}])
def test_what_is_no_name_is_unknown(name):
    with pytest.raises(ValueError, match="unknown frame encoder"):
        FrameSettings.get(name)
