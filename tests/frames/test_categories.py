"""Categories: linear frames are a linear layer on one-hot vectors, patches sums of embeddings."""

import pytest
import torch
from torch.nn import functional as F

from torchrl_tit import settings
from torchrl_tit.frames import Observation
from torchrl_tit.frames.linear import LinearFrameEncoder
from torchrl_tit.layers.categories import CategoryIndex, CategoryPatchEmbedding
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


def test_class_tokens_tell_every_category_apart() -> None:
    encoder = build_frame(settings.Inner(embed_dim=8), OBSERVATION).double()
    x = torch.cartesian_prod(*map(torch.arange, COUNTS))
    tokens = encoder(x.unsqueeze(1)).flatten(1)
    assert len(tokens.detach().round(decimals=6).unique(dim=0)) == len(x) == 60
    assert [maps.shape[-1] for maps in encoder.attention_maps(x)] == [4, 4]
