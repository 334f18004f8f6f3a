"""The base class of algorithms that train on a data set."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, TypeVar

from tensordict import TensorDictBase
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from .algorithm import Algorithm, Stateful
from .dataset_recipe import DatasetRecipe

RecipeT = TypeVar("RecipeT", bound=DatasetRecipe)


class Buffer(Stateful, Protocol):
    """A source of batches, such as a replay buffer."""

    def sample(self) -> TensorDictBase:
        """Samples a batch."""


class DatasetAlgorithm(Algorithm[RecipeT]):
    """An algorithm that samples its batches from a replay buffer of a data set."""

    buffer: Buffer
    """The replay buffer, once :meth:`prepare` has made it."""

    @abstractmethod
    def make_buffer(self) -> Buffer:
        """Reads the data set into a replay buffer.

        Raises:
            FileNotFoundError: if there are no such data.
            DatasetError: if they cannot be used, or belong to another task.
            ValueError: if they do not fit the networks.
        """

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches from the replay buffer forever."""
        while True:
            yield self.buffer.sample()

    def check(self) -> None:
        """Lets the policy act once in the task, and reads the data unless they are remote."""
        super().check()
        if not is_remote(self.recipe.dataset):
            self.make_buffer()


def is_remote(dataset: str) -> bool:
    """Whether a data set is one of D4RL's that has to be downloaded.

    Example:
        >>> is_remote("hopper-medium-v2"), is_remote("data/cartpole/mixed.hdf5")
        (True, False)
    """
    return dataset in D4RL_DATASETS and not Path(dataset).exists()
