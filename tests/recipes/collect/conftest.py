"""Collections of data that several tests read, made once."""

from dataclasses import replace
from pathlib import Path

import pytest

from recipes.core.recipe_json import recipe_to_json
from recipes.tools.collect import Collection
from recipes.tools.collect.collect import collect
from tests.recipes.collect.collected import CARTPOLE, CARTPOLE_RECIPE, PENDULUM, PENDULUM_RECIPE


@pytest.fixture(scope="session")
def cartpole_settings(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    path = tmp_path_factory.mktemp("recipe") / "ppo.json"
    path.write_text(recipe_to_json(CARTPOLE_RECIPE))
    return replace(CARTPOLE, agent=str(path))


@pytest.fixture(scope="session")
def pendulum_settings(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    path = tmp_path_factory.mktemp("recipe") / "sac.json"
    path.write_text(recipe_to_json(PENDULUM_RECIPE))
    return replace(PENDULUM, agent=str(path))


def _collect(settings: Collection, factory: pytest.TempPathFactory) -> Path:
    folder = factory.mktemp("collected") / "sets"
    collect(settings, folder, "the command")
    return folder


@pytest.fixture(scope="session")
def cartpole(cartpole_settings: Collection, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All sets of a discrete task."""
    return _collect(cartpole_settings, tmp_path_factory)


@pytest.fixture(scope="session")
def pendulum(pendulum_settings: Collection, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All sets of a continuous task."""
    return _collect(pendulum_settings, tmp_path_factory)
