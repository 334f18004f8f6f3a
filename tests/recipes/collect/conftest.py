"""Collections of data that several tests read, made once."""

from dataclasses import replace
from pathlib import Path

import pytest

from recipes.collect import collect
from recipes.recipe import recipe_to_json
from tests.recipes.collect.collected import CARTPOLE, PENDULUM, RECIPE


@pytest.fixture(scope="session")
def agent(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("recipe") / "small.json"
    path.write_text(recipe_to_json(RECIPE))
    return str(path)


@pytest.fixture(scope="session")
def cartpole(agent: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All sets of a discrete task, collected once."""
    folder = tmp_path_factory.mktemp("collected") / "cartpole"
    collect(replace(CARTPOLE, agent=agent), folder, "the command")
    return folder


@pytest.fixture(scope="session")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All sets of a continuous task, collected once."""
    folder = tmp_path_factory.mktemp("collected") / "pendulum"
    collect(PENDULUM, folder, "the command")
    return folder
