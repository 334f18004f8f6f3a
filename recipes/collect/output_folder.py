"""The folder of `data collect`: the settings that it belongs to, and the provenance of its data."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchrl_tit.files import write_text_atomic

from ..recipe import Recipe
from ..recipe_json import recipe_to_json
from ..run import package_versions
from .settings import KINDS, Collection, Kind


def claim_folder(
    folder: Path, settings: Collection, recipe: Recipe | None, command: str
) -> dict[str, Any]:
    """Records the settings in a folder, or checks that they match those recorded there.

    Args:
        folder: the folder.
        settings: what is to be made.
        recipe: the agent's recipe, if there is an agent.
        command: the command line.

    Returns:
        The provenance that every data set records.

    Raises:
        ValueError: if the folder holds sets with other settings.
        FileExistsError: if it holds anything else.
    """
    record: dict[str, Any] = {
        "settings": json.loads(json.dumps(asdict(settings))),
        "recipe": None if recipe is None else json.loads(recipe_to_json(recipe)),
        "versions": package_versions(),
        "command": command,
    }
    path = folder / "settings.json"
    if path.exists():
        _check(folder, _read(path), record, settings)
    elif any(other.name != ".lock" for other in folder.iterdir()):
        raise FileExistsError(
            f"{folder} holds something other than collected data: name another folder with --out"
        )
    write_text_atomic(path, json.dumps(record, indent=2) + "\n")
    return {
        "env_id": settings.env,
        "seed": settings.seed,
        "command": command,
        "settings": json.dumps(record["settings"]),
        "versions": json.dumps(record["versions"]),
        **({} if recipe is None else {"recipe": json.dumps(record["recipe"])}),
    }


def hdf5_path(folder: Path, kind: Kind) -> Path:
    """The HDF5 file of a set."""
    return folder / f"{kind}.hdf5"


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(record["settings"], dict):
            raise ValueError("it lacks the settings")
        return {"recipe": None, **record}
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}): name another folder with --out"
        ) from error


def _check(folder: Path, before: dict[str, Any], now: dict[str, Any], settings: Collection) -> None:
    """Raises ValueError if a folder holds data that these settings would not produce."""
    old, new = dict(before["settings"]), dict(now["settings"])
    steps = old.get("total_steps", 0)
    for values in (old, new):
        for name in ("sets", "threads", "total_steps"):  # the data do not depend on these
            values.pop(name, None)
    changes = [f"{k}: {old.get(k)!r} -> {new[k]!r}" for k in new if old.get(k) != new[k]]
    recipes = [dict(recipe) for recipe in (before["recipe"], now["recipe"]) if recipe is not None]
    # The recipe takes these from the settings, which are compared above.
    adapted = ["seed", "threads", "checkpoint_interval"]
    for recipe in recipes:
        for name in [*adapted, "total_steps"] if settings.agent == "sac" else adapted:
            recipe.pop(name, None)
    if len(recipes) == 2 and recipes[0] != recipes[1]:
        changes.append(f"the recipe {settings.agent}")
    # Longer training ends with another agent.
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
