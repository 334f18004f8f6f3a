"""What data must satisfy before training: finite values, the shapes and bounds of their task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import Space
from gymnasium.envs.registration import parse_env_id
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from numpy.typing import NDArray
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_tit.envs import is_atari, make_games
from torchrl_tit.envs.given import GivenTask
from torchrl_tit.envs.gymnasium_tasks import make_unchecked
from torchrl_tit.envs.names import find_task, load_wrappers
from torchrl_tit.envs.spaces import ObservationReader, only_space
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import ImageLayout

FLAGS = ("terminals", "timeouts")

# Actions of a squashed policy reach the bounds, and rounding moves some slightly beyond them.
_ACTION_TOLERANCE = 1e-5


class DatasetError(ValueError):
    """A data set is damaged, incomplete, or of another task; the message names file, field and row.

    Args:
        source: the file, or another description of the source.
        problem: what is wrong, what was expected and what to do.
        field: name of the field, if the problem is in one.
        row: index of the row, if the problem is in one.

    Example:
        >>> print(DatasetError("a.hdf5", "is nan, but must be finite.", "rewards", 3))
        a.hdf5: field 'rewards', row 3: is nan, but must be finite.
    """

    def __init__(
        self, source: str, problem: str, field: str | None = None, row: int | None = None
    ) -> None:
        place = "" if field is None else f" field {field!r}"
        place += "" if row is None else f"{',' if place else ''} row {row}"
        super().__init__(f"{source}:{place}{':' if place else ''} {problem}")


class TaskSpaces(NamedTuple):
    """The spaces of a task.

    Attributes:
        observation: Gymnasium's space of one observation.
        action: Gymnasium's space of one action.
        name: the task's name, for error messages.
    """

    observation: Space
    action: Space
    name: str = "the task"


@checked_arguments
def task_spaces(
    env_name: str,
    *,
    wrappers: Sequence[str] = (),
    observation_keys: Sequence[str] = (),
    image_layout: ImageLayout = "auto",
    **settings: Any,
) -> TaskSpaces:
    """Returns the spaces of a Gymnasium task.

    Args:
        env_name: a name that Gymnasium has registered, such as "Hopper-v5". Atari games such as
            "ALE/Pong-v5" have the observations of :func:`~torchrl_tit.envs.make_env`: one gray
            image of 84 x 84.
        wrappers: Gymnasium wrappers around it, then TorchRL transforms; see
            :func:`~torchrl_tit.envs.make_env`.
        observation_keys: names of the observations to keep, for a task with several; all if empty.
            If it is one, its space is returned.
        image_layout: where the images that transforms read have their channels: see
            :func:`~torchrl_tit.envs.make_env`.
        **settings: passed to `gymnasium.make`.

    Returns:
        Its spaces.

    Raises:
        ValueError: if the task cannot be made.

    Example:
        >>> task_spaces("Pendulum-v1").action.shape
        (1,)
    """
    wraps, transforms = load_wrappers(wrappers)
    if is_atari(env_name):
        games = make_games(env_name, **settings)
        games.close()
        observation = _transformed(games.single_observation_space, transforms, image_layout)
        return TaskSpaces(observation, games.single_action_space, env_name)
    if ":" in env_name and callable(find_task(env_name)):
        raise ValueError(
            f"Task {env_name!r} makes a TorchRL environment, but data sets are compared with a "
            "Gymnasium task: name one, or leave the task out"
        )
    try:
        env = make_unchecked(env_name, **settings)
    except Exception as error:  # a package is missing, the task has no such setting, ...
        raise ValueError(f"Task {env_name!r} cannot be made: {error}") from error
    try:
        for wrap in wraps:
            env = wrap(env)
        observation = only_space(env.observation_space, observation_keys)
        observation = _transformed(observation, transforms, image_layout)
        return TaskSpaces(observation, env.action_space, env_name)
    finally:
        env.close()


def _transformed(space: Space, transforms: Sequence[Transform], layout: ImageLayout) -> Space:
    """The space of what transforms, some of which ask for a task, make of an observation."""
    if not transforms:
        return space
    before = ObservationReader(space, image_layout=layout).spec
    task = GivenTask({"observation": before}, Unbounded(1), lambda begins: {})
    after = TransformedEnv(task, Compose(*transforms)).observation_spec_unbatched["observation"]
    if after == before:
        return space
    if after.dtype == torch.uint8:
        return Box(0, 255, tuple(after.shape), np.uint8)
    return Box(-np.inf, np.inf, tuple(after.shape), np.float32)


def check_task_name(source: str, recorded: object, task: TaskSpaces) -> None:
    """Checks that the data set's recorded task is the requested one.

    Tasks with spaces of the same shapes, such as HalfCheetah and Walker2d, cannot be told apart
    otherwise.

    Args:
        source: where the data came from, for error messages.
        recorded: the recorded name of the task; anything but a string if there is none.
        task: the requested task. The versions may differ. If its name does not have Gymnasium's
            form, nothing is checked.

    Raises:
        DatasetError: if it is another task.

    Example:
        >>> check_task_name("a.hdf5", "Pendulum-v0", task_spaces("Pendulum-v1"))
        >>> check_task_name("a.hdf5", "CartPole-v1", task_spaces("Pendulum-v1"))
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: field 'env_id': is CartPole-v1, but t...
    """
    if not isinstance(recorded, str):
        return
    try:
        (space, name, _), (task_space, task_name, _) = map(parse_env_id, (recorded, task.name))
    except gymnasium.error.Error:
        return
    if space == task_space and name.lower() != task_name.lower():
        raise DatasetError(
            source, f"is {recorded}, but the task is {task.name}: use other data.", "env_id"
        )


def check_shape(
    source: str, field: str, shape: tuple[int, ...], space: Space, task: TaskSpaces
) -> None:
    """Checks that one row of observations or actions has the shape of the task's space.

    Raises:
        DatasetError: if the shape differs.

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


def check_bytes(source: str, dtype: torch.dtype, space: Space, task: TaskSpaces) -> None:
    """Checks that observations are bytes where those of the task are: networks divide bytes by 255.

    Raises:
        DatasetError: if only one of the two is uint8.

    Example:
        >>> task = task_spaces("Pendulum-v1")
        >>> check_bytes("a.hdf5", torch.float32, task.observation, task)
    """
    if isinstance(space, Box) and (dtype == torch.uint8) != (space.dtype == np.uint8):
        raise DatasetError(
            source,
            f"is {str(dtype).removeprefix('torch.')}, but in {task.name} it is {space.dtype}, and "
            "networks divide uint8 by 255, and nothing else: store it as the task has it.",
            "observations",
        )


def check_finite(
    source: str,
    field: str,
    values: NDArray,
    first_row: int = 0,
    kept_as: torch.dtype = torch.float64,
) -> None:
    """Checks that values are finite, also after conversion, or integers that fit.

    Args:
        source: where the data came from, for error messages.
        field: name of the field.
        values: some rows of it.
        first_row: index of the first of these rows.
        kept_as: the dtype that they are converted to, which may have a smaller range.

    Raises:
        DatasetError: if a value is not finite or too large; the message names the first such row.

    Example:
        >>> check_finite("a.hdf5", "rewards", np.array([0.0, np.nan]), first_row=100)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: field 'rewards', row 101: is nan, but...
    """
    kind, largest = str(kept_as).removeprefix("torch."), np.iinfo(np.int64).max
    if np.issubdtype(values.dtype, np.floating):
        wrong = ~plain_tensor(values).to(kept_as).isfinite().numpy()
    elif values.dtype == np.uint64:
        wrong = values > largest
    else:
        return
    if wrong.any():
        row, value = _first(wrong, values)
        allowed = f"at most {largest}, the largest {kind}"
        if np.issubdtype(values.dtype, np.floating):
            allowed = f"finite as {kind}" if np.isfinite(value) else "finite"
        problem = f"is {value}, but all values must be {allowed}."
        raise DatasetError(source, problem, field, first_row + row)


def check_actions(source: str, values: NDArray, space: Space, first_row: int = 0) -> None:
    """Checks that actions lie in the action space.

    Args:
        source: where the data came from, for error messages.
        values: some rows of the actions.
        space: a `Box`, `Discrete`, `MultiDiscrete` or `MultiBinary` action space; others are not
            checked.
        first_row: index of the first of these rows.

    Raises:
        DatasetError: if an action lies outside; the message names the first such row.

    Example:
        >>> check_actions("a.hdf5", np.array([[1.5]]), Box(-1.0, 1.0, (1,)))
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: field 'actions', row 0: is 1.5, but...
    """
    if isinstance(space, Box):
        low, high, tolerance = space.low, space.high, _ACTION_TOLERANCE
    elif isinstance(space, Discrete | MultiDiscrete):
        count = space.n if isinstance(space, Discrete) else space.nvec
        low, tolerance = np.asarray(space.start), 0.0
        high = low + count - 1
    elif isinstance(space, MultiBinary):
        low, high, tolerance = np.array(0), np.array(1), 0.0
    else:
        return
    wrong = (values < low - tolerance) | (values > high + tolerance)
    if wrong.any():
        row, value, lowest, highest = _first(wrong, *np.broadcast_arrays(values, low, high))
        problem = f"is {value}, but the task's actions range from {lowest} to {highest} here."
        raise DatasetError(source, problem, "actions", first_row + row)


def check_limit(source: str, lengths: NDArray, max_episode_steps: int | None) -> None:
    """Checks that no episode is longer than a time limit.

    Args:
        source: where the data came from, for error messages.
        lengths: number of steps of each episode, int64 [E].
        max_episode_steps: the limit, if there is one.

    Raises:
        DatasetError: if one is: the limit ends episodes only in data that do not mark their ends.

    Example:
        >>> check_limit("a.hdf5", np.array([9, 25]), max_episode_steps=10)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: has an episode of 25 steps, but...
    """
    if max_episode_steps is not None and (longest := int(lengths.max())) > max_episode_steps:
        raise DatasetError(
            source,
            f"has an episode of {longest} steps, but max_episode_steps is {max_episode_steps}: "
            "leave it out, or remove 'timeouts' that do not mark all ends.",
        )


def _first(wrong: NDArray, *arrays: NDArray) -> tuple:
    """The row of the first wrong entry, and what each array holds there."""
    place = tuple(np.argwhere(wrong)[0])
    return (int(place[0]), *(array[place] for array in arrays))


def kept_dtype(source: str, field: str, dtype: np.dtype, floats: torch.dtype | None) -> torch.dtype:
    """Returns the dtype in which a field is stored.

    Args:
        source: where the data came from, for error messages.
        field: name of the field.
        dtype: the field's dtype in the source.
        floats: the dtype for floats; None keeps that of the source.

    Returns:
        The dtype: bool for flags, floating for rewards, uint8 or int64 for other integers.

    Raises:
        DatasetError: if the field's values are not numbers.
        ValueError: if ``floats`` is not a floating-point dtype.

    Example:
        >>> kept_dtype("a.hdf5", "rewards", np.dtype("float64"), torch.float32)
        torch.float32
    """
    if not (floats is None or (isinstance(floats, torch.dtype) and floats.is_floating_point)):
        raise ValueError(f"dtype is that of floats, such as torch.float32, not {floats}")
    if dtype.kind not in "biuf":
        raise DatasetError(source, f"has the dtype {dtype}, but must have a numeric one.", field)
    if dtype.kind == "f" and dtype.itemsize > 8:
        raise DatasetError(
            source, f"has the dtype {dtype}, which PyTorch lacks: store it as float64.", field
        )
    if field in FLAGS:
        return torch.bool
    if dtype.kind == "f":
        return floats or plain_tensor(np.empty(0, dtype)).dtype
    if field == "rewards":
        return floats or torch.float32
    return torch.uint8 if dtype == np.uint8 else torch.int64


def plain_tensor(values: NDArray) -> Tensor:
    """Converts an array, in any byte order and memory layout, into a tensor.

    Example:
        >>> plain_tensor(np.array([1.0, 2.0], dtype=">f8"))
        tensor([1., 2.], dtype=torch.float64)
    """
    return torch.from_numpy(np.ascontiguousarray(values, values.dtype.newbyteorder("=")))
