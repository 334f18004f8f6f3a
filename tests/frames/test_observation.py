"""What networks know of the observations that they read."""

import pytest
import torch
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    Unbounded,
)

from torchrl_tit.frames import Observation, read_observation, read_observations


@pytest.mark.parametrize(
    ("observation", "shape", "kind", "entries"),
    [
        ((5,), (5,), "array", 5),
        (torch.Size([3, 8, 8]), (3, 8, 8), "image", 192),
        (Unbounded(5), (5,), "array", 5),
        (Bounded(0, 255, (8, 8), dtype=torch.uint8), (8, 8), "image", 64),
        (MultiCategorical([4]), (1,), "categories", 4),
        (MultiCategorical([4, 3]), (2,), "categories", 7),
        (Categorical(4, shape=(2,)), (2,), "categories", 8),
        (Binary(3), (3,), "categories", 6),
        (Observation((2,), categories=(4, 3)), (2,), "categories", 7),
    ],
)
def test_shapes_and_specs(observation, shape, kind, entries):
    seen = read_observation(observation)
    assert (seen.shape, seen.kind, seen.entries) == (shape, kind, entries)
    assert seen.zeros(2, 3).shape == (2, 3, *shape)
    assert seen.zeros().is_floating_point() == (kind != "categories" and seen.dtype != torch.uint8)


def test_one_observation_or_several_by_name():
    assert list(read_observations((4,))) == ["observation"]
    specs = {"image": (3, 7, 7), "arm/left": Unbounded(2)}
    assert [seen.kind for seen in read_observations(specs).values()] == ["image", "array"]
    nested = Composite(pixels=Unbounded((8, 8)), arm=Composite(left=Unbounded(2)))
    assert set(read_observations(nested)) == {"pixels", "arm/left"}
