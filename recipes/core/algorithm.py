"""The contract of algorithms: everything in an experiment except the training loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_tit.evaluation import evaluate

from .evaluation import HeldOut, Outcome
from .recipe import Recipe

RecipeT = TypeVar("RecipeT", bound=Recipe)
Terms: TypeAlias = TensorDictBase | Mapping[str, Tensor]
"""Terms of a loss by name, float [] each."""


class Stateful(Protocol):
    """An object whose state a checkpoint stores: a module, an optimizer, a replay buffer."""

    def state_dict(self) -> dict[str, Any]:
        """Returns the state."""

    def load_state_dict(self, state_dict: dict[str, Any], /) -> Any:
        """Restores a state."""


class NotFiniteError(FloatingPointError):
    """A reward, a loss, a gradient or a weight is NaN or infinite."""


class Algorithm(ABC, Generic[RecipeT]):
    """Networks, data and update of an experiment.

    The constructor builds only the networks, which is enough for evaluation. :meth:`prepare` builds
    the rest. The runner (:mod:`recipes.core.runner`) has the only loop: it takes a batch, calls
    :meth:`update`, and handles what all experiments share (progress, metrics, checkpoints, resume,
    interrupts, evaluation).

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the networks cannot be built with these settings.
    """

    model: nn.Module
    """All networks: what a checkpoint stores, and evaluation loads."""
    columns: Sequence[str]
    """Names of the numbers that an update returns: columns of the metrics."""
    optional_columns: Sequence[str] = ()
    """The columns that may be NaN, because there is nothing to measure yet."""
    held_out_columns: Sequence[str] = ()
    """Names of what :meth:`measure` measures: columns of the metrics."""

    def __init__(self, recipe: RecipeT) -> None:
        self.recipe = recipe
        self.device = torch_device(recipe.device)

    @property
    @abstractmethod
    def policy(self) -> TensorDictModuleBase:
        """The policy, which acts in the environments of :meth:`make_env`.

        It holds all that acting needs: weights, statistics, bounds of actions. Agents and exported
        files are made of it alone.
        """

    @abstractmethod
    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the environment with everything that the policy reads.

        Args:
            num_envs: number of environments.
            seed: seed of the first environment; environment i has seed + i.
            **settings: further settings of the task, such as ``render_mode="rgb_array"``.
        """

    @abstractmethod
    def prepare(self, step: int, folder: Path) -> None:
        """Builds what training needs besides the networks: optimizers, data, environments.

        Afterwards, networks are in training mode if batches come from a data set, and in evaluation
        mode, without dropout, if the policy collects them.

        Args:
            step: number of steps done so far: 0, or more if a run is resumed.
            folder: the run folder, where the algorithm may store data.
        """

    @abstractmethod
    def batches(self) -> Iterator[Any]:
        """Yields the batch of each update."""

    def size(self, batch: Any) -> int:
        """Returns the number of steps in a batch; by default, a batch is one gradient step."""
        return 1

    @abstractmethod
    def update(self, batch: Any, step: int) -> Mapping[str, Tensor | float]:
        """Updates the networks on a batch.

        Args:
            batch: what :meth:`batches` yielded.
            step: number of steps done before.

        Returns:
            A number for each of ``columns``, float [].

        Raises:
            NotFiniteError: if a loss, a gradient or a weight is not finite.
        """

    @abstractmethod
    def state(self) -> Mapping[str, Stateful]:
        """Returns what a checkpoint stores besides the networks, so that a resume loses nothing.

        Collectors and environments are not part of it: a resumed run begins new episodes.
        """

    def returns(self, batch: Any) -> Tensor | None:
        """Gets the returns of episodes that ended in a batch, float [episodes]; None if offline."""
        return None

    def play(self, step: int) -> list[Outcome]:
        """Evaluates the current weights, for each target return if there are any.

        Full episodes are played, each with its own seed, with the most likely actions, raw rewards
        and no dropout. Without an environment, there is nothing to play, and no outcome.

        Args:
            step: number of steps done so far.
        """
        recipe = self.recipe
        if not recipe.env:
            return []
        seed, episodes = recipe.evaluation_seed, recipe.evaluation_episodes
        shrink = recipe.offline
        returns = evaluate(self.make_env, self.policy, episodes, seed=seed, shrink=shrink)
        return [Outcome(step, returns.tolist())]

    def measure(self, step: int) -> HeldOut | None:
        """Measures the current weights on held-out episodes; None if there are none.

        Args:
            step: number of steps done so far.
        """
        return None

    def check(self) -> None:
        """Takes one step with the policy, and makes other cheap checks before a run starts.

        Raises:
            ValueError: if environment, wrappers, networks and data do not match.
        """
        recipe = self.recipe
        with closing(self.make_env(1, recipe.seed)) as env, torch.no_grad():
            try:
                env.step(self.policy(env.reset()))
            except Exception as error:  # a wrapper can raise anything
                if not recipe.wrappers:
                    raise
                # The text of a KeyError would be one long line.
                reason = str(*error.args[:1]).partition("\n")[0] or type(error).__name__
                raise ValueError(
                    f"the wrappers {list(recipe.wrappers)} do not fit {recipe.task_name}: {reason}"
                ) from error

    def close(self) -> None:
        """Closes the environments and processes that :meth:`prepare` started."""


def make_algorithm(recipe: Recipe) -> Algorithm[Any]:
    """Builds the algorithm of a recipe.

    Raises:
        ValueError: if its networks cannot be built with these settings, or it has a module with
            weights that are not among those of its model.
    """
    try:
        algorithm = recipe.build()
    except TypeError as error:  # for example, no network here reads this kind of observation
        raise ValueError(str(error)) from error
    networks = (algorithm.model, algorithm.policy)
    saved = {weight.data_ptr() for part in networks for weight in part.parameters()}
    for name, part in vars(algorithm).items():
        weights = part.parameters() if isinstance(part, nn.Module) else ()
        if any(weight.requires_grad and weight.data_ptr() not in saved for weight in weights):
            raise ValueError(
                f"{type(algorithm).__name__}.{name} has weights that are neither trained nor "
                "saved: put it into what networks() returns"
            )
    return algorithm


def torch_device(device: str) -> torch.device:
    """Returns the PyTorch device for a recipe's ``device``.

    Raises:
        ValueError: if there is no such device.

    Example:
        >>> torch_device("cpu")
        device(type='cpu')
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=device).device
    except (AssertionError, RuntimeError) as error:  # unknown, or not there
        reason = str(error).splitlines()[0].split(". ")[0]  # the rest lists 50 backends
        raise ValueError(
            f"device is {device!r}, which PyTorch does not find ({reason}): use 'cpu' or 'auto'"
        ) from error


def storage_device(recipe: Any) -> torch.device:
    """Returns the PyTorch device for a recipe's ``storage_device``; beside networks on the CPU, it.

    Raises:
        ValueError: if there is no such device.
    """
    own = torch_device(recipe.device)
    return own if own.type == "cpu" else torch_device(recipe.storage_device)


def to_networks(batch: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Moves a batch of stored data to the networks' device, through pinned memory to a GPU.

    Example:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"reward": torch.ones(8, 1)}, [8])
        >>> to_networks(batch, torch.device("meta"))["reward"].device
        device(type='meta')
    """
    stored = next(iter(batch.values(True, True))).device
    if stored == device:
        return batch
    if device.type == "cuda" and stored.type == "cpu":
        # What is expanded, such as states of zeros, cannot be pinned.
        return batch.contiguous().pin_memory().to(device, non_blocking=True)
    return batch.to(device)


def load_weights(networks: Stateful, weights: Mapping[str, Any]) -> None:
    """Loads weights strictly: names, shapes and dtypes must match, and values must be finite.

    ``load_state_dict`` alone converts dtypes and accepts NaNs; TorchRL's also accepts states that
    lack weights.

    Args:
        networks: the networks.
        weights: their state, by name.

    Raises:
        ValueError: if a weight is missing, has another dtype, or is not finite where the networks'
            own is.
        RuntimeError: if there are other names, or shapes differ.

    Example:
        >>> linear = torch.nn.Linear(1, 1)
        >>> load_weights(linear, {**linear.state_dict(), "bias": torch.tensor([torch.nan])})
        Traceback (most recent call last):
            ...
        ValueError: bias has entries that are not finite
    """
    own = networks.state_dict()
    if missing := [name for name in own if name not in weights]:
        raise ValueError(f"Missing key {missing[0]}")
    for name, weight in weights.items():
        expected = own.get(name)
        if not (isinstance(weight, Tensor) and isinstance(expected, Tensor)):
            continue
        if weight.dtype != expected.dtype:
            raise ValueError(f"{name} is {weight.dtype}, not {expected.dtype}")
        if not weight.isfinite().all() and expected.isfinite().all():
            raise ValueError(f"{name} has entries that are not finite")
    networks.load_state_dict(dict(weights))


def total_loss(terms: Terms) -> Tensor:
    """Adds up the terms of a loss, those whose names begin with "loss_"; float []."""
    return torch.stack([term for name, term in terms.items() if name.startswith("loss_")]).sum()


def descend(terms: Terms, optimizer: torch.optim.Optimizer) -> Tensor:
    """Takes a gradient step on the sum of the terms whose names begin with "loss_".

    Args:
        terms: the terms of a loss, and other numbers.
        optimizer: of all weights; it leaves those alone on which the sum does not depend.

    Returns:
        The sum, detached.
    """
    total = total_loss(terms)
    optimizer.zero_grad()
    total.backward()
    optimizer.step()
    return total.detach()


def check_finite(names: Sequence[str], values: Tensor) -> None:
    """Checks that values are finite.

    Args:
        names: names of the values.
        values: float [names].

    Raises:
        NotFiniteError: if one is not; the message names the first.
    """
    finite = values.isfinite()
    if not finite.all():
        index = int(finite.logical_not().nonzero()[0])
        raise NotFiniteError(f"{names[index]} became {values[index].item()}")


def check_weights(networks: nn.Module) -> None:
    """Checks that weights are finite: a gradient may not be, although its loss is.

    Raises:
        NotFiniteError: if one is not; the message names the first.

    Example:
        >>> layer = nn.Linear(1, 1)
        >>> _ = nn.init.constant_(layer.bias, torch.nan)
        >>> check_weights(layer)
        Traceback (most recent call last):
            ...
        recipes.core.algorithm.NotFiniteError: the weight bias became nan
    """
    weights = {f"the weight {name}": x for name, x in networks.named_parameters()}
    check_finite(list(weights), torch.stack([x.detach().sum() for x in weights.values()]))


def check_without_waiting(names: Sequence[str], values: Tensor) -> None:
    """As :func:`check_finite`, on the CPU only.

    Reading a number back from a GPU waits for all its work, so what is there is checked by the
    runner, before it writes metrics or a checkpoint.
    """
    if values.device.type == "cpu":
        check_finite(names, values)


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Adds a place to the message of a FloatingPointError.

    Example:
        >>> with naming("in CartPole-v1"):
        ...     raise FloatingPointError("the reward of copy 0 is nan")
        Traceback (most recent call last):
            ...
        recipes.core.algorithm.NotFiniteError: the reward of copy 0 is nan in CartPole-v1
    """
    try:
        yield
    except FloatingPointError as error:
        raise NotFiniteError(f"{error} {where}") from error
