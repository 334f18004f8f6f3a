"""Connections to a Ray cluster, whose machines share a file system."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from torchrl_tit.settings.imports import allowed_modules

_PATIENCE = 30.0  # seconds that a cluster has to answer; it needs two or three
_ASK = """
import json, sys, ray
ray.init(sys.argv[1], log_to_driver=False)
print(json.dumps([node["Resources"] for node in ray.nodes() if node["Alive"]]))
"""


def ask_for_machines(address: str) -> list[dict[str, float]]:
    """Returns the resources of each machine of a cluster, and does not stay connected to it.

    Args:
        address: "auto" or ``HOST:PORT`` on a machine of the cluster, ``ray://HOST:PORT`` elsewhere.

    Raises:
        ValueError: if Ray is missing, or no cluster answers there.
    """
    _import_ray()
    # Ray itself waits for ten minutes or more if no cluster answers.
    try:
        answer = subprocess.run(
            [sys.executable, "-c", _ASK, address],
            check=True,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
        )
    except subprocess.TimeoutExpired as error:
        raise ValueError(
            f"no Ray cluster answered at {address!r} in {_PATIENCE:.0f} seconds: is it the address "
            "that `ray start --head` printed, or ray://HOST:10001 from outside the cluster?"
        ) from error
    except subprocess.CalledProcessError as error:
        reason = error.stderr.strip().splitlines()[-1:]
        raise ValueError(f"no connection to Ray at {address!r}: {' '.join(reason)}") from error
    return json.loads(answer.stdout.splitlines()[-1])


def connect(address: str) -> None:
    """Connects this process to a cluster, unless it is connected already.

    Args:
        address: as that of :func:`ask_for_machines`.

    Raises:
        ValueError: if Ray is missing, or no cluster answers there.
    """
    ray = _import_ray()
    if ray.is_initialized():
        return
    ask_for_machines(address)
    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)


def _import_ray() -> ModuleType:
    try:
        import ray
    except ImportError as error:
        raise ValueError("Ray is not installed: pip install 'torchrl-tit[ray]'") from error
    return ray


def import_variables() -> dict[str, str]:
    """Environment variables with which Ray's workers import what this process can.

    That is what is in the working directory, and the modules that the user named.
    """
    modules = [
        str(Path(module).absolute()) if module.endswith(".py") else module
        for module in allowed_modules()
    ]
    folders = [os.getcwd(), *(str(Path(module).parent) for module in modules if "/" in module)]
    folders += filter(None, [os.environ.get("PYTHONPATH")])
    return {
        "PYTHONPATH": os.pathsep.join(folders),
        "TORCHRL_TIT_IMPORTS": os.pathsep.join(modules),
    }


def check_address(recipe: Any) -> None:
    """Checks the field ``ray`` of a recipe.

    Raises:
        ValueError: if it is empty, or an address for processes outside the cluster.
    """
    if recipe.ray is None:
        return
    if not recipe.ray:
        raise ValueError("ray is empty: it is the address of a Ray cluster, such as auto")
    if recipe.ray.startswith("ray://"):
        raise ValueError(
            f"ray is {recipe.ray!r}, an address for programs outside the cluster, but collectors "
            "get their weights straight from the training process: start it on a machine of the "
            "cluster, with auto or HOST:PORT"
        )
