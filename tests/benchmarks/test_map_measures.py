"""Maps as numbers."""

from __future__ import annotations

import math

import pytest
import torch

from benchmarks.map_measures import find_objects, map_change, share_on_objects
from tests.numerics import assert_near


def test_objects_move_before_a_still_background() -> None:
    frames = torch.full((5, 6, 6), 80, dtype=torch.uint8)
    frames[:, 0] = 200  # a wall that stands still
    for step in range(5):
        frames[step, 3, step] = 255  # a ball
    objects = find_objects(frames)
    assert objects.nonzero().tolist() == [[step, 3, step] for step in range(5)]


def test_objects_have_another_color_than_the_ground() -> None:
    frames = torch.zeros(2, 3, 6, 6)
    frames[:, 1] = 0.4  # green ground
    frames[:, 0, 2:4, 2:4] = 0.9
    objects = find_objects(frames, background="color")
    assert objects.sum((1, 2)).tolist() == [4, 4]
    assert objects[:, 2:4, 2:4].all()
    assert not find_objects(frames, background="color", tolerance=0.95).any()
    assert not find_objects(frames).any(), "nothing moves"


def test_share_on_objects() -> None:
    objects = torch.zeros(2, 12, 12, dtype=torch.bool)
    objects[0, :6, :3] = True  # half of a cell, of four
    objects[1] = True
    maps = torch.tensor([[[2.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
    share, area = share_on_objects(maps, objects)
    assert_near(area, torch.tensor([0.125, 1.0]))
    assert share[0] == 0.25
    assert math.isnan(share[1]), "a map of zeros has no share"
    uniform, area = share_on_objects(torch.ones(2, 4, 4), objects)
    assert_near(uniform, area)


def test_change() -> None:
    maps = torch.zeros(4, 14, 14)
    maps[0, 0, 0] = 5
    maps[1, 1, 1] = 1  # in the same cell of 7 x 7
    maps[2, 13, 13] = 1
    maps[3, 13, 13] = maps[3, 0, 0] = 1
    assert_near(map_change(maps), torch.tensor([0.0, 1.0, 0.5]))
    assert_near(map_change(maps[:, :3, :3])[:1], torch.tensor([1.0]))  # coarser than the grid
    assert math.isnan(map_change(torch.zeros(2, 3, 3))[0])


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="field 'background' is 'sky', not one of"):
        find_objects(torch.zeros(2, 4, 4), background="sky")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"frames have the shape \[4, 4\]"):
        find_objects(torch.zeros(4, 4))
    with pytest.raises(ValueError, match="of the same frames"):
        share_on_objects(torch.ones(2, 4, 4), torch.ones(3, 8, 8, dtype=torch.bool))
    with pytest.raises(ValueError, match="at least two maps"):
        map_change(torch.ones(1, 4, 4))
