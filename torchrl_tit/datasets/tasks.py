"""Requirements of a Gymnasium task on its data."""

from __future__ import annotations

from typing import NamedTuple

import gymnasium
from gymnasium import Space
from gymnasium.envs.registration import parse_env_id

from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.envs import is_atari, make_games
from torchrl_tit.envs.gymnasium_tasks import make_unchecked
from torchrl_tit.settings.arguments import checked_arguments


class TaskSpaces(NamedTuple):
    """The spaces of a task.

    Attributes:
        observation: Gymnasium's space of one observation.
        action: Gymnasium's space of one action.
        name: The task's name, for error messages.
    """

    observation: Space
    action: Space
    name: str = "the task"


@checked_arguments
def task_spaces(env_name: str) -> TaskSpaces:
    """Returns the spaces of a Gymnasium task.

    Args:
        env_name: A name that Gymnasium has registered, such as "Hopper-v5". Atari games such as
            "ALE/Pong-v5" have the observations of :func:`~torchrl_tit.envs.make_env`: one grey
            image of 84 x 84.

    Returns:
        Its spaces.

    Raises:
        ValueError: If the task cannot be made.

    Example:
        >>> task_spaces("Pendulum-v1").action.shape
        (1,)
    """
    if is_atari(env_name):
        games = make_games(env_name)
        games.close()
        return TaskSpaces(games.single_observation_space, games.single_action_space, env_name)
    try:
        env = make_unchecked(env_name)
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(f"Task {env_name!r} cannot be made: {error}") from error
    try:
        return TaskSpaces(env.observation_space, env.action_space, env_name)
    finally:
        env.close()


def check_task_name(source: str, recorded: object, task: TaskSpaces) -> None:
    """Checks that the data set's recorded task is the requested one.

    Tasks with spaces of the same shapes, such as HalfCheetah and Walker2d, cannot be told apart
    otherwise.

    Args:
        source: Where the data came from, for error messages.
        recorded: The recorded name of the task; anything but a string if there is none.
        task: The requested task. The versions may differ. If its name does not have Gymnasium's
            form, nothing is checked.

    Raises:
        DatasetError: If it is another task.

    Example:
        >>> check_task_name("a.hdf5", "Pendulum-v0", task_spaces("Pendulum-v1"))
        >>> check_task_name("a.hdf5", "CartPole-v1", task_spaces("Pendulum-v1"))
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'env_id': is CartPole-v1, but t...
    """
    if not isinstance(recorded, str):
        return
    try:
        (space, name, _), (task_space, task_name, _) = map(parse_env_id, (recorded, task.name))
    except gymnasium.error.Error:
        return
    if space == task_space and name.lower() != task_name.lower():
        raise DatasetError(
            source,
            f"is {recorded}, but the task is {task.name}: use other data.",
            "env_id",
        )


def check_shape(
    source: str, field: str, shape: tuple[int, ...], space: Space, task: TaskSpaces
) -> None:
    """Checks that observations or actions have the same shape as the task's.

    Args:
        source: Where the data came from, for error messages.
        field: Name of the field.
        shape: Shape of one row.
        space: The space of that field.
        task: The task, for error messages.

    Raises:
        DatasetError: If the shape differs.

    Example:
        >>> task = task_spaces("Pendulum-v1")
        >>> check_shape("a.hdf5", "actions", (1,), task.action, task)
    """
    expected = space.shape or ()
    # A scalar may be stored as a column.
    if shape != expected and not (expected == () and shape == (1,)):
        raise DatasetError(
            source,
            f"one row has the shape {list(shape)}, but in {task.name} it is {list(expected)}; "
            f"the data set is of another task.",
            field,
        )
