"""The folder of `data collect`, and what the data in it say about themselves."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchrl_tit.files import write_text_atomic

from ..recipe import recipe_to_json
from ..run import package_versions
from .agents import Source
from .settings import KINDS, Collection, Kind


def claim_folder(
    folder: Path, settings: Collection, agent: Source | None, command: str
) -> dict[str, Any]:
    """Notes in a folder what is made there, or checks that it is the same.

    Args:
        folder: the folder.
        settings: what is to be made.
        agent: the agent, whose recipe is noted too.
        command: the command line.

    Returns:
        What every data set says about where it is from.

    Raises:
        ValueError: if the folder holds sets with other settings.
        FileExistsError: if there is something else in it.
    """
    recipe = None if agent is None or agent.recipe is None else recipe_to_json(agent.recipe)
    noted: dict[str, Any] = {
        "settings": json.loads(json.dumps(asdict(settings))),
        "recipe": None if recipe is None else json.loads(recipe),
        "versions": package_versions(),
        "command": command,
    }
    path = folder / "settings.json"
    if path.exists():
        _check(folder, _read(path), noted, settings)
    elif any(other.name != ".lock" for other in folder.iterdir()):
        raise FileExistsError(
            f"{folder} has something else in it than collected data: name another folder with --out"
        )
    write_text_atomic(path, json.dumps(noted, indent=2) + "\n")
    return {
        "env_id": settings.env,
        "seed": settings.seed,
        "command": command,
        "settings": json.dumps(noted["settings"]),
        "versions": json.dumps(noted["versions"]),
        **({} if recipe is None else {"recipe": json.dumps(noted["recipe"])}),
    }


def hdf5_path(folder: Path, kind: Kind) -> Path:
    """The file of a set."""
    return folder / f"{kind}.hdf5"


def minari_path(folder: Path, kind: Kind) -> Path:
    """The Minari folder of a set; Minari wants a version in its name."""
    return folder.absolute() / f"{kind}-v0"


def _read(path: Path) -> dict[str, Any]:
    try:
        noted = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(noted["settings"], dict):
            raise ValueError("its settings are none")
        return {"recipe": None, **noted}
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}): name another folder with --out"
        ) from error


def _check(folder: Path, before: dict[str, Any], now: dict[str, Any], settings: Collection) -> None:
    """Raises ValueError where a folder cannot be gone on with."""
    old, new = dict(before["settings"]), dict(now["settings"])
    steps = old.get("total_steps", 0)
    for fields in (old, new):
        for name in ("sets", "threads", "total_steps"):  # these make no other data
            fields.pop(name, None)
    changes = [f"{k}: {old.get(k)!r} -> {new[k]!r}" for k in new if old.get(k) != new[k]]
    recipes = [dict(recipe) for recipe in (before["recipe"], now["recipe"]) if recipe is not None]
    for recipe in recipes:
        recipe.pop("threads", None)
    if len(recipes) == 2 and recipes[0] != recipes[1]:
        changes.append(f"the recipe {settings.agent}")
    # A longer training ends in another agent.
    of_the_end = [k for k in KINDS if k != "random" and settings.mark(k)[1] is None]
    if settings.total_steps < steps or (
        settings.total_steps > steps and any(hdf5_path(folder, k).exists() for k in of_the_end)
    ):
        changes.append(f"total_steps: {steps} -> {settings.total_steps}")
    if changes:
        raise ValueError(
            f"{folder} holds data of other settings ({'; '.join(changes)}): name another folder "
            "with --out, or move it away"
        )
