"""Chained outer blocks, and temporal positions of every encoder that has the choice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import pytest
import torch

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit import settings
from torchrl_tit.histories import HistoryEncoder, HistoryShape
from torchrl_tit.settings import HistorySettings, TemporalPositions

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

WIDTH, FRAMES = 8, 4


def make(choices: HistorySettings, num_tokens: int = 3) -> Any:
    encoder = choices.build(HistoryShape(num_frames=FRAMES, num_tokens=num_tokens, width=WIDTH))
    assert isinstance(encoder, HistoryEncoder)
    randomize(encoder)
    return encoder


@pytest.mark.parametrize("share", [False, True])
def test_a_chained_block_reads_its_token_and_the_block_before(share: bool) -> None:
    chained = make(settings.ChainedOuter(num_heads=2, share_blocks=share))
    tokens = torch.randn(5, FRAMES, 3, WIDTH)
    x, outputs, maps = torch.zeros(5, FRAMES, WIDTH), [], []
    for index in range(3):
        block = chained.blocks[0 if share else index]
        maps.append(block.attention.weights(block.norm1(x + tokens[:, :, index])))
        x = block(x + tokens[:, :, index])
        outputs.append(x[:, -1])
    assert_near(chained(tokens), torch.cat(outputs, dim=-1))
    assert_near(chained.attention_maps(tokens), maps)
    assert len(chained.blocks) == (1 if share else 3)


@pytest.mark.parametrize("kind", [settings.Outer, settings.ChainedOuter])
def test_two_blocks_that_attend_to_three_frames_see_five(kind: Any) -> None:
    encoder = kind(attention_frames=3, temporal_positions="rotary").build(
        HistoryShape(num_frames=5, num_tokens=2, width=WIDTH)
    )
    randomize(encoder)
    tokens = torch.randn(4, 5, 2, WIDTH, requires_grad=True)
    encoder(tokens).sum().backward()
    assert tokens.grad is not None
    assert tokens.grad[:, 0, 0].abs().amin() > 0
    band = torch.ones(5, 5, dtype=torch.bool).tril().triu(-2)
    for maps in encoder.attention_maps(tokens.detach()):
        assert torch.equal(maps != 0, band.expand_as(maps))
    # What the first block says of the middle frame does not depend on what precedes the two before.
    block, x = encoder.blocks[0], torch.randn(4, 5, WIDTH)
    assert_near(block(x, mask=band)[:, 4:], block(x[:, 2:], read="last"))


def test_attention_frames_that_do_not_fit() -> None:
    shape = HistoryShape(num_frames=4, num_tokens=3, width=WIDTH)
    message = (
        "3 outer blocks with attention_frames 2 see 4 frames, but num_frames is 5: set it to 4"
    )
    with pytest.raises(ValueError, match=message):
        settings.ChainedOuter(attention_frames=2).build(replace(shape, num_frames=5))
    message = "not 'learned': set temporal_positions to rotary or none"
    with pytest.raises(ValueError, match=message):
        settings.ChainedOuter(attention_frames=2, temporal_positions="learned").build(shape)


KINDS: dict[str, Any] = {
    "outer": settings.Outer,
    "paired-outer": settings.PairedOuter,
    "chained-outer": settings.ChainedOuter,
    "catformer": settings.Catformer,
}


@pytest.mark.parametrize("positions", get_args(TemporalPositions))
@pytest.mark.parametrize("kind", KINDS)
def test_temporal_positions(kind: str, positions: TemporalPositions) -> None:
    encoder = make(KINDS[kind](num_heads=2, temporal_positions=positions), num_tokens=1)
    names = set(encoder.state_dict())
    assert ("positions" in names) == (positions == "learned")
    assert any("relative" in name for name in names) == (positions == "relative")
    tokens = torch.randn(6, FRAMES, 1, WIDTH)
    for weights in encoder.attention_maps(tokens):
        assert torch.equal(weights, weights.tril())
        assert_near(weights.sum(-1), torch.ones_like(weights[..., 0]))
    # Same frames at every step are told apart by learned positions only.
    same = tokens[:, :1].expand(-1, FRAMES, -1, -1)
    (weights, *_) = encoder.attention_maps(same)
    uniform = torch.ones(FRAMES, FRAMES).tril() / torch.arange(1, FRAMES + 1).unsqueeze(-1)
    assert torch.allclose(weights, uniform.expand_as(weights)) == (positions == "none")
    assert encoder(tokens).shape == (6, encoder.out_features)


def test_fields_of_an_older_version_are_read() -> None:
    for old, new in ((True, "learned"), (False, "none")):
        fields = {"temporal_position_encoding": old, "num_heads": 2}
        assert settings.PairedOuter(**settings.PairedOuter.from_older(fields)) == (
            settings.PairedOuter(num_heads=2, temporal_positions=new)  # type: ignore[arg-type]
        )
    with pytest.raises(ValueError, match="temporal_position_encoding is true or false, not 1"):
        settings.Outer.from_older({"temporal_position_encoding": 1})
