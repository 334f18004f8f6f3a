"""What networks know of observations, the patch size "auto", and categories: one-hot vectors."""

import re

import pytest
import torch
from torch.nn import functional as F
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiCategorical, Unbounded

from torchrl_tit import settings
from torchrl_tit.frames import Observation, read_observation, read_observations
from torchrl_tit.frames.linear import LinearFrameEncoder
from torchrl_tit.layers.categories import CategoryIndex, CategoryPatchEmbedding
from torchrl_tit.layers.patches import find_patch_size
from torchrl_tit.networks.building import build_frame

COUNTS = (4, 3, 5)
OBSERVATION = Observation((3,), categories=COUNTS)


def rows(*leading: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    entries = [torch.randint(count, leading, generator=generator) for count in COUNTS]
    return torch.stack(entries, -1)


def one_hot(x: torch.Tensor) -> torch.Tensor:
    entries = zip(x.unbind(-1), COUNTS, strict=True)
    return torch.cat([F.one_hot(entry, count) for entry, count in entries], -1)


def test_one_hot_vectors_stand_side_by_side() -> None:
    x = rows(2, 7)
    assert torch.equal(CategoryIndex(COUNTS).one_hot(x).long(), one_hot(x))
    flat = build_frame(settings.Flat(), OBSERVATION)
    assert (flat.width, flat.num_tokens) == (12, 1)
    assert torch.equal(flat(x).long(), one_hot(x).unsqueeze(-2))


@pytest.mark.parametrize("row", [[4, 0, 0], [0, -1, 0], [0, 3, 0], [-1, 0, 0], [0, 0, 5]])
@pytest.mark.parametrize("frame", [settings.Flat(), settings.Linear(), settings.Inner()])
def test_a_value_of_a_neighboring_entry_is_refused(frame, row) -> None:
    encoder = build_frame(frame, OBSERVATION)
    expected = rf"has the categories {re.escape(str(row))}, .* below that of \[4, 3, 5\]"
    with pytest.raises(ValueError, match=expected):
        encoder(torch.tensor([[0, 0, 0], row]))


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32, torch.uint8])
def test_linear_frames_are_a_linear_layer_on_one_hot_vectors(dtype: torch.dtype) -> None:
    choices = settings.Linear(embed_dim=8, bias=True, activation="tanh")
    encoder = build_frame(choices, OBSERVATION).double()
    assert isinstance(encoder, LinearFrameEncoder)
    x = rows(2, 7)
    expected = torch.tanh(encoder.linear(one_hot(x).double())).unsqueeze(-2)
    torch.testing.assert_close(encoder(x.to(dtype)), expected)
    gradients = [
        torch.autograd.grad(tokens.square().sum(), encoder.linear.weight)[0]
        for tokens in (encoder(x.to(dtype)), expected)
    ]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize(
    ("patch_size", "patches"), [(1, 3), (2, 2), (3, 1), (None, 1), ("auto", 3)]
)
def test_a_patch_is_a_linear_layer_on_the_one_hot_vectors_of_its_entries(patch_size, patches):
    inner = build_frame(settings.Inner(patch_size=patch_size, embed_dim=8), OBSERVATION).double()
    embedding = inner.patch_embedding
    assert isinstance(embedding, CategoryPatchEmbedding)
    x = rows(7)
    tokens = embedding(x.unsqueeze(1))
    assert tokens.shape == (7, patches, 8)
    size = -(-len(COUNTS) // patches)
    for patch in range(patches):
        entries = range(3)[patch * size : (patch + 1) * size]
        used = torch.cat([torch.full((n,), i in entries) for i, n in enumerate(COUNTS)])
        expected = (one_hot(x) * used).double() @ embedding.embedding.weight
        torch.testing.assert_close(tokens[:, patch], expected)


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
    auto = build_frame(settings.Inner(embed_dim=4, patch_size="auto"), Observation(shape))
    named = build_frame(settings.Inner(embed_dim=4, patch_size=patch_size), Observation(shape))
    assert str(auto) == str(named)


@pytest.mark.parametrize(
    ("entries", "patch_size"),
    [(1, 1), (16, 1), (18, 2), (27, 3), (105, 7), (17, 17), (376, 47)],  # nothing divides 17
)
def test_auto_of_categories(entries, patch_size):
    assert find_patch_size((entries,), "auto", categories=True) == patch_size
    observation = Observation((entries,), categories=(3,) * entries)
    auto = build_frame(settings.Inner(embed_dim=4, patch_size="auto"), observation)
    named = build_frame(settings.Inner(embed_dim=4, patch_size=patch_size), observation)
    assert str(auto) == str(named)
