"""Collections of data that several tests read, made once."""

from dataclasses import replace
from pathlib import Path

import pytest

from recipes.collect import Collection
from recipes.collect.collect import collect
from recipes.recipe_json import recipe_to_json
from tests.recipes.collect.collected import (
    CARTPOLE,
    CARTPOLE_RECIPE,
    PENDULUM,
    PENDULUM_RECIPE,
)


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


@pytest.fixture(scope="session")
def cartpole(cartpole_settings: Collection, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All sets of a discrete task, collected once."""
    folder = tmp_path_factory.mktemp("collected") / "cartpole"
    collect(cartpole_settings, folder, "the command")
    return folder


@pytest.fixture(scope="session")
def pendulum(pendulum_settings: Collection, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All sets of a continuous task, collected once."""
    folder = tmp_path_factory.mktemp("collected") / "pendulum"
    collect(pendulum_settings, folder, "the command")
    return folder
