"""Catformer: what it does beyond equality with the reference in tests/interop."""

from __future__ import annotations

import pytest

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


def test_transformers_over_time_read_several_frames() -> None:
    for kind in (Catformer, CoBERL, GTrXL):
        with pytest.raises(ValueError, match="over time, but num_frames is 1: set it to 2 or more"):
            kind((84, 84), 1)
