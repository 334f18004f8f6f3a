"""Connections to a Ray cluster, whose machines share a file system.

Anyone who reaches a cluster can run anything on its machines, so Ray's token authentication is on
unless the user switches it off.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from torchrl_tit.extras import missing
from torchrl_tit.settings.imports import allowed_modules

_MODE, _LOOPBACK = "RAY_AUTH_MODE", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_PATIENCE = 30.0  # seconds to wait for a cluster's answer, which takes two or three
_ASK = """
import json, sys, ray
ray.init(sys.argv[1], log_to_driver=False)
print(json.dumps([node["Resources"] for node in ray.nodes() if node["Alive"]]))
"""


def ask_for_machines(address: str) -> list[dict[str, float]]:
    """Returns the resources of each machine of a cluster, without staying connected to it.

    Args:
        address: "auto" or ``HOST:PORT`` on a machine of the cluster, ``ray://HOST:PORT`` elsewhere.

    Raises:
        ValueError: if Ray is missing, or no cluster answers there.
    """
    if find_spec("ray") is None:
        raise ValueError(missing("ray"))
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
            "that `ray start --head` printed, or ray://HOST:10001 from outside the cluster? If it "
            f"listens on 127.0.0.1 only, {_LOOPBACK}=0 must be set here, too"
        ) from error
    except subprocess.CalledProcessError as error:
        if "uthentication" in error.stderr:
            raise ValueError(
                f"the Ray cluster at {address!r} and this process have no authentication token in "
                "common: `ray get-auth-token --generate` on one machine, copy ~/.ray/auth_token to "
                f"the others, and start Ray with {_MODE}=token; {_MODE}=disabled goes without"
            ) from error
        reason = error.stderr.strip().splitlines()[-1:]
        raise ValueError(f"no connection to Ray at {address!r}: {' '.join(reason)}") from error
    return json.loads(answer.stdout.splitlines()[-1])


def check_room(
    machines: Sequence[dict[str, float]], address: str, collectors: int, threads: int
) -> None:
    """Checks that machines have enough CPUs, even if others are using them now.

    Raises:
        ValueError: if they do not; Ray itself would wait silently.

    Example:
        >>> check_room([{"CPU": 4.0}, {"CPU": 3.0}], "auto", collectors=4, threads=2)
        Traceback (most recent call last):
            ...
        ValueError: the Ray cluster at 'auto' has room for 3 collectors of 2 CPUs (threads), not ...
    """
    room = sum(int(machine.get("CPU", 0)) // threads for machine in machines)
    if room < collectors:
        raise ValueError(
            f"the Ray cluster at {address!r} has room for {room} collectors of {threads} CPUs "
            f"(threads), not for {collectors}: add machines, or lower collectors or threads"
        )


def connect(address: str) -> None:
    """Connects this process to a cluster, unless it is connected already.

    Args:
        address: as in :func:`ask_for_machines`.

    Raises:
        ValueError: if Ray is missing, or no cluster answers there.
    """
    loaded = sys.modules.get("ray")
    if loaded is not None and loaded.is_initialized():
        return
    ask_for_machines(address)
    import ray

    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)


def import_variables() -> dict[str, str]:
    """Returns environment variables that let Ray's workers import what this process can.

    These are the modules in the working directory, and those that the user named.
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
