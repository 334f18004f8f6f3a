"""Rows of categories: their one-hot vectors, and embeddings of patches of their entries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class CategoryIndex(nn.Module):
    """Numbers the values of all entries of a row consecutively, from the first entry to the last.

    Args:
        counts: number of values of each entry.

    Example:
        >>> CategoryIndex([4, 3])(torch.tensor([[1, 0], [3, 2]]))
        tensor([[1, 4],
                [3, 6]])
    """

    counts: Tensor
    first: Tensor

    def __init__(self, counts: Sequence[int]) -> None:
        super().__init__()
        first = torch.tensor([0, *accumulate(counts)][:-1])
        self.register_buffer("counts", torch.tensor(counts), persistent=False)
        self.register_buffer("first", first, persistent=False)
        self.total = sum(counts)

    def forward(self, x: Tensor) -> Tensor:
        """Integers [..., D] -> int64 [..., D].

        A value that an entry does not have, which would be one of a neighboring entry, becomes the
        number after the last, so that looking it up is an error.
        """
        return torch.where(self._wrong(x), self.total, x.long() + self.first)

    def embed(self, x: Tensor, weight: Tensor) -> Tensor:
        """Looks integers [..., D] up in a table [total, width] -> [..., D, width]."""
        try:
            return F.embedding(self(x), weight)
        except IndexError as error:  # raised on a CPU only; a GPU reports a failed assertion
            raise self._error(x) from error

    def one_hot(self, x: Tensor) -> Tensor:
        """Integers [..., D] -> the one-hot vectors of all entries, bool [..., total]."""
        zeros = x.new_zeros(*x.shape[:-1], self.total, dtype=torch.bool)
        try:
            return zeros.scatter(-1, self(x), True)
        except RuntimeError as error:  # as above
            if self._wrong(x).any():
                raise self._error(x) from error
            raise

    def _wrong(self, x: Tensor) -> Tensor:
        return (x < 0) | (x >= self.counts)

    def _error(self, x: Tensor) -> ValueError:
        row = x[self._wrong(x).any(-1)][0].tolist()
        return ValueError(
            f"an observation has the categories {row}, but each must be at least 0 and below that "
            f"of {self.counts.tolist()}: build the network with the spec of what is observed"
        )


class CategoryPatchEmbedding(nn.Module):
    """Embeds P neighboring categories as one token: the sum of their embeddings.

    This is a linear layer on the one-hot vectors of the patch, without a bias. The last patch may
    have fewer entries.

    Args:
        counts: number of values of each of the D entries.
        patch_size: number P of entries per patch.
        embed_dim: width of a token.

    Example:
        >>> embedding = CategoryPatchEmbedding([4, 3, 2], patch_size=2, embed_dim=32)
        >>> embedding(torch.zeros(8, 1, 3, dtype=torch.int64)).shape
        torch.Size([8, 2, 32])
    """

    def __init__(self, counts: Sequence[int], patch_size: int, embed_dim: int) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.num_patches = math.ceil(len(counts) / patch_size)
        self.padding = self.num_patches * patch_size - len(counts)
        self.index = CategoryIndex(counts)
        self.embedding = nn.Embedding(sum(counts), embed_dim)

    def forward(self, x: Tensor) -> Tensor:
        """Integers [N, 1, D] -> tokens [N, ceil(D / P), embed_dim]."""
        entries = self.index.embed(x.squeeze(1), self.embedding.weight)  # [N, D, embed_dim]
        if self.patch_size == 1:
            return entries
        entries = F.pad(entries, (0, 0, 0, self.padding))
        return entries.unflatten(1, (self.num_patches, self.patch_size)).sum(2)
