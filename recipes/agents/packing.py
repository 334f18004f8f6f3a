"""The files of an agent, from a run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path, PurePath
from typing import Any

from safetensors.torch import save
from torch import Tensor, nn

from torchrl_tit.agents import AgentError
from torchrl_tit.agents.folder import CARD, EVALUATION, RECIPE, VERSIONS, WEIGHTS

from ..dataset_recipe import DatasetRecipe
from ..recipe import Recipe
from ..recipe_json import recipe_to_json
from ..run import Run
from ..runner import load_trained
from .building import evaluation_of, read_json
from .card import Facts, make_card


def pack(
    folder: Path, name: str, *, source: str | None = None, license: str | None = None
) -> tuple[dict[str, bytes], int]:
    """Makes the files of an agent from a run's newest checkpoint and its evaluation.

    They hold what acting needs and a record of how the agent was trained: no optimizer, no replay
    buffer, no networks that only training uses, and no names of folders or machines.

    Args:
        folder: the run folder.
        name: the agent's name, the title of its card.
        source: what :func:`~torchrl_tit.agents.load_agent` will find it by, for its card; its name
            if None.
        license: identifier of its licence, such as "mit", for its card; none is named if None.

    Returns:
        The files by name, as :func:`~torchrl_tit.agents.folder.write_agent` takes them, and the
        steps that the agent was trained for.

    Raises:
        FileNotFoundError: if there is no run or no checkpoint.
        AgentError: if the newest checkpoint was not evaluated, a name is invalid, or
            huggingface_hub, which writes the card's metadata, is missing.
        ValueError: if the run's networks cannot be built.
    """
    _check_words("name", name)
    if license is not None:
        _check_words("license", license)
    run = Run.open(folder)
    steps, algorithm, _ = load_trained(run)
    evaluation = evaluation_of(folder, steps)
    if not evaluation:
        raise AgentError(
            f"{folder} has no evaluation of its newest checkpoint, that of step {steps}: run "
            f"`evaluate {folder}` first"
        )
    versions = read_json(folder / "versions.json")
    networks = algorithm.acting_networks()
    recipe = without_places(run.recipe)
    if isinstance(recipe, DatasetRecipe):
        evaluation["dataset"] = recipe.dataset
    parameters = sum(weight.numel() for weight in networks.parameters())
    facts = Facts(name, source or name, license, recipe, steps, evaluation, versions, parameters)
    files = {
        CARD: make_card(facts).encode(),
        RECIPE: recipe_to_json(recipe).encode(),
        WEIGHTS: save(_weights(networks)),
        EVALUATION: _json(evaluation),
        VERSIONS: _json(versions),
    }
    return files, steps


def without_places(recipe: Recipe) -> Recipe:
    """Returns a recipe without the folders and addresses of the machines that it ran on.

    If the data set is a file, the file's name is kept.

    Example:
        >>> from recipes.registry import get_recipe
        >>> recipe = replace(get_recipe("bc/hopper-medium-v2/mlp"), dataset="/data/hopper.hdf5")
        >>> without_places(recipe).dataset
        'hopper.hdf5'
    """
    changed: dict[str, Any] = {}
    if isinstance(recipe, DatasetRecipe):
        path = PurePath(recipe.dataset)
        if path.is_absolute() or path.suffix:  # otherwise it is a name from D4RL or Minari
            changed["dataset"] = path.name
    if "ray" in {field.name for field in fields(recipe)}:
        changed["ray"] = None
    return replace(recipe, **changed)


def _weights(networks: nn.Module) -> dict[str, Tensor]:
    """The tensors of networks by name, each with its own memory."""
    weights = {}
    for name, value in networks.state_dict().items():
        if not isinstance(value, Tensor):
            raise AgentError(f"{name} is a {type(value).__name__}, and safetensors hold tensors")
        weights[name] = value.detach().cpu().contiguous().clone()
    return weights


def _check_words(what: str, value: str) -> None:
    if not re.fullmatch(r"\w[\w.-]*", value):
        raise AgentError(f"{what} must be letters, digits, '_', '.' and '-', not {value!r}")


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()
