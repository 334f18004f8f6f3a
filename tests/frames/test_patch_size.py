"""The patch size "auto": an array as a whole, 16 patches of categories, about 49 of an image."""

import pytest

from torchrl_tit.frames import Observation
from torchrl_tit.layers.patches import find_patch_size
from torchrl_tit.networks.building import build_frame
from torchrl_tit.settings import Inner


@pytest.mark.parametrize(
    ("shape", "patch_size"),
    [
        ((1,), 1),
        ((17,), 17),
        ((376,), 376),
        ((7, 7), 1),
        ((3, 84, 84), 12),
        ((3, 56, 56), 8),
        ((3, 64, 64), 8),
        ((3, 96, 96), 16),
        ((3, 64, 48), 8),
        ((3, 210, 160), 10),
        ((83, 83), 83),
    ],
)
def test_auto(shape, patch_size):
    assert find_patch_size(shape, "auto") == patch_size
    auto = build_frame(Inner(embed_dim=4, patch_size="auto"), Observation(shape))
    named = build_frame(Inner(embed_dim=4, patch_size=patch_size), Observation(shape))
    assert str(auto) == str(named)


@pytest.mark.parametrize(
    ("entries", "patch_size"),
    [(1, 1), (16, 1), (18, 2), (27, 3), (105, 7), (17, 17), (376, 47)],  # nothing divides 17
)
def test_auto_of_categories(entries, patch_size):
    assert find_patch_size((entries,), "auto", categories=True) == patch_size
    observation = Observation((entries,), categories=(3,) * entries)
    auto = build_frame(Inner(embed_dim=4, patch_size="auto"), observation)
    named = build_frame(Inner(embed_dim=4, patch_size=patch_size), observation)
    assert str(auto) == str(named)
