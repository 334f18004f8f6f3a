"""`data collect`: data sets of a task, made the way D4RL's were."""

from __future__ import annotations

from pathlib import Path

import filelock
import torch
from gymnasium.spaces import Box, Discrete

from torchrl_tit.datasets import TaskSpaces, task_spaces
from torchrl_tit.envs.actions import ActionWriter
from torchrl_tit.envs.spaces import ObservationReader
from torchrl_tit.files import remove_leftovers

from .find_agent import find_agent
from .output_folder import claim_folder
from .set_maker import SetMaker
from .settings import KINDS, Collection


def collect(settings: Collection, folder: Path, command: str = "") -> list[str]:
    """Makes data sets in a folder, except those that are there already.

        settings.json             settings, recipe, versions and command
        training/                 the agent's run folder, from which training resumes
        random.hdf5, random-v0/   a data set in D4RL's layout, and the same as a Minari data set
        mixed.hdf5, mixed-v0/ ...

    Work that a killed process finished is not repeated. A training that it cut off goes on from its
    newest checkpoint with new episodes.

    Args:
        settings: what to make.
        folder: the output folder; created if missing.
        command: the command line, which is recorded in the data.

    Returns:
        A line for each set.

    Raises:
        ValueError: if the settings are invalid, the folder holds sets with other settings, or a
            mark is never reached. Sets that were made before are kept.
        FileExistsError: if the folder holds anything else.
        RuntimeError: if another process uses the folder.
        OSError: if something cannot be written.

    Example:
        >>> import tempfile
        >>> settings = Collection(env="CartPole-v1", sets=("random",), transitions=100)
        >>> [line] = collect(settings, Path(tempfile.mkdtemp()))
        >>> line.split(" transitions")[0]
        'random: 1...'
    """
    torch.set_num_threads(settings.threads)
    task = task_spaces(settings.env)
    if not _is_recorded_as_it_is(task):
        raise ValueError(
            f"{settings.env} has observations {task.observation} and actions {task.action}, but "
            "data can be collected of one array or image (a Box of floats or uint8, channels "
            "first) and of a vector (a Box of floats) or one choice (Discrete, from 0)"
        )
    agent = find_agent(settings, folder / "training", task.action)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(folder / ".lock", timeout=0):
            remove_leftovers(folder)
            recipe = None if agent is None else agent.recipe
            provenance = claim_folder(folder, settings, recipe, command)
            maker = SetMaker(settings, folder, task, agent, provenance)
            return [maker.make(kind) for kind in KINDS if kind in settings.sets]
    except filelock.Timeout as error:
        raise RuntimeError(
            f"{folder} is in use by another process: wait for it, or stop it"
        ) from error


def _is_recorded_as_it_is(task: TaskSpaces) -> bool:
    """Whether tensordicts hold the task's observations and actions unchanged."""
    if not (isinstance(task.observation, Box) and isinstance(task.action, Box | Discrete)):
        return False
    if task.observation.dtype.kind != "f" and task.observation.dtype != "uint8":
        return False
    try:
        observation = ObservationReader(task.observation).spec
        action = ActionWriter(task.action, clip=False).spec
    except (TypeError, ValueError):  # such as an image of unknown layout
        return False
    return (
        observation.shape == task.observation.shape
        and action.shape == task.action.shape
        and task.action.dtype.kind == ("i" if isinstance(task.action, Discrete) else "f")
        and getattr(task.action, "start", 0) == 0
    )
