"""`data collect`: data sets of a task, made the way D4RL's were."""

from __future__ import annotations

from pathlib import Path

import filelock
import torch
from gymnasium.spaces import Box, Discrete

from torchrl_tit.datasets import task_spaces

from .agents import find_agent
from .folder import claim_folder
from .set_maker import SetMaker
from .settings import KINDS, Collection


def collect(settings: Collection, folder: Path, command: str = "") -> list[str]:
    """Makes data sets in a folder, those that are not there yet.

        settings.json             settings, recipe, versions and command
        training/                 the agent's training, from which it can go on
        random.hdf5, random-v0/   a data set in D4RL's layout, and the same as a Minari data set
        mixed.hdf5, mixed-v0/ ...

    What a killed process has finished is not done again, and the outcome is that of one that was
    not killed (for games, whose state cannot be saved, one like it).

    Args:
        settings: what to make.
        folder: where; made where missing.
        command: the command line, which is noted in the data.

    Returns:
        A line for each set.

    Raises:
        ValueError: if the settings cannot be, the folder holds sets with others, or a mark is never
            reached. What was made before stays.
        FileExistsError: if there is something else in the folder.
        RuntimeError: if another process is at work in the folder.
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
    if not (isinstance(task.observation, Box) and isinstance(task.action, Box | Discrete)):
        raise ValueError(
            f"{settings.env} has observations {task.observation} and actions {task.action}, but "
            "data can be collected of one array (Box) and of an array or one choice (Discrete)"
        )
    agent = find_agent(settings)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(folder / ".lock", timeout=0):
            provenance = claim_folder(folder, settings, agent, command)
            maker = SetMaker(settings, folder, task, agent, provenance)
            return [maker.make(kind) for kind in KINDS if kind in settings.sets]
    except filelock.Timeout as error:
        raise RuntimeError(
            f"{folder} is in use by another process: wait for it, or stop it"
        ) from error
