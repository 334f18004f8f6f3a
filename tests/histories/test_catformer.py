"""Catformer: what it does beyond equality with the reference in tests/interop."""

from __future__ import annotations

import pytest
import torch

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit import settings
from torchrl_tit.histories import HistoryShape
from torchrl_tit.histories.catformer import Catformer as CatformerEncoder
from torchrl_tit.networks import Catformer, CoBERL, GTrXL

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def test_defaults_are_the_protocols() -> None:
    network = Catformer((84, 84), 4)
    shapes = {name: tuple(p.shape) for name, p in network.named_parameters()}
    assert shapes["frame_encoders.observation.linear.weight"] == (255, 25_600)
    assert shapes["history_encoder.positions"] == (1, 4, 255)
    assert shapes["history_encoder.attentions.1.projection.weight"] == (255, 510)
    assert shapes["history_encoder.ffns.0.1.weight"] == (1020, 255)
    assert shapes["history_encoder.ffns.1.1.weight"] == (1020, 765)
    assert shapes["head.1.weight"] == (512, 255)
    assert not any(name.startswith("history_encoder.attentions.0.projection") for name in shapes)


@pytest.mark.parametrize("num_blocks", [1, 2, 3])
def test_steps_are_told_apart_and_maps_are_causal(num_blocks: int) -> None:
    torch.manual_seed(0)
    shape = HistoryShape(num_frames=4, num_tokens=1, width=12)
    encoder = CatformerEncoder(settings.Catformer(num_heads=3, num_blocks=num_blocks), shape)
    randomize(encoder)
    tokens = torch.randn(2, 5, 4, 1, 12)
    features = encoder(tokens)
    assert features.shape == (2, 5, 12)
    assert not torch.allclose(encoder(tokens[:, :, [1, 0, 2, 3]]), features, atol=1e-3)
    maps = encoder.attention_maps(tokens)
    assert len(maps) == num_blocks
    for weights in maps:
        assert weights.shape == (2, 5, 3, 4, 4)
        assert_near(weights.sum(-1), torch.ones(2, 5, 3, 4))
        assert torch.equal(weights, weights.tril())


def test_transformers_over_time_read_several_frames() -> None:
    for kind in (Catformer, CoBERL, GTrXL):
        with pytest.raises(ValueError, match="over time, but num_frames is 1: set it to 2 or more"):
            kind((84, 84), 1)
