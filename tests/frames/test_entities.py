"""Sets of entities: padding counts nowhere, and what an MLP on the padded vector learns slowly."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_tit import settings
from torchrl_tit.analysis import map_attention
from torchrl_tit.datasets import episodes_from_arrays
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.networks import HistoryNetwork

ENTITIES, ENTRIES, SEATS = 3, 4, 5


def observations(*leading: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Up to three entities, and the same rows with padding of any numbers between them."""
    generator = torch.Generator().manual_seed(seed)
    few = 3 + 2 * torch.randn(*leading, ENTITIES, ENTRIES, generator=generator).double()
    few[..., -1] = (torch.rand(*leading, ENTITIES, generator=generator) < 0.7).double()
    padding = few.new_full((*leading, SEATS - ENTITIES, ENTRIES), 1e6)
    padding[..., 0, :] = torch.nan
    padding[..., -1] = torch.tensor([0.0, -7.0])
    return few, torch.cat([few, padding], -2)[..., torch.tensor([3, 1, 0, 4, 2]), :]


def networks(normalized: bool) -> list[HistoryNetwork]:
    """The same weights for three rows and for five."""
    built = []
    for rows in (ENTITIES, SEATS):
        torch.manual_seed(0)
        frame, history = settings.Entities(num_heads=2), settings.PairedOuter()
        shape = (rows, ENTRIES)
        network = HistoryNetwork(frame, history, observation_shape=shape, num_frames=2).double()
        if normalized:
            encoder = NormalizedFrames(network.frames[0]).double()
            network.frame_encoders["observation"] = encoder
        built.append(network)
    built[1].load_state_dict(built[0].state_dict())
    return built


@pytest.mark.parametrize("normalized", [False, True])
def test_padding_counts_nowhere(normalized: bool) -> None:
    """Not its numbers, its place or its length, in outputs, gradients, statistics and maps."""
    short, long = networks(normalized)
    few, many = observations(6, 2)
    few[0, 0, :, -1] = many[0, 0, :, -1] = 0  # no entities at all
    results = []
    for network, history in ((short, few), (long, many)):
        if normalized:
            encoder = network.frames[0]
            assert isinstance(encoder, NormalizedFrames)
            encoder.update(history.flatten(0, 1))
            encoder.update(history[:1, 0])  # without entities
        history.requires_grad_()
        features = network(history)
        features.square().sum().backward()
        results.append([features, *network.buffers(), *(p.grad for p in network.parameters())])
    torch.testing.assert_close(*results)
    assert many.grad is not None
    is_entity = many[..., -1] > 0
    assert torch.equal(many.grad[..., :-1].abs().sum(-1) > 0, is_entity)
    (maps,) = map_attention(long, many).values()
    assert maps.shape == (6, 2, SEATS, 1)
    assert torch.equal(maps.squeeze(-1) > 0, is_entity)
    torch.testing.assert_close(maps.sum((-2, -1)), is_entity.any(-1).double())


def test_statistics_are_those_of_all_entities() -> None:
    _, many = observations(200)
    rows = many[many[..., -1] > 0][:, :-1]
    running = NormalizedFrames(settings.Entities().build((SEATS, ENTRIES))).double()
    for part in many.split([1, 50, 149]):
        running.update(part)
    stored = NormalizedFrames(settings.Entities().build((SEATS, ENTRIES))).double()
    ends = torch.zeros(199, dtype=torch.bool)
    ends[-1] = True
    episodes = episodes_from_arrays(
        observations=many[:-1].nan_to_num().float().numpy(),
        actions=torch.zeros(199, 1).numpy(),
        rewards=torch.zeros(199).numpy(),
        terminals=ends.numpy(),
        timeouts=torch.zeros_like(ends).numpy(),
    )
    stored.set_statistics(*episodes.observation_statistics(stored.samples))
    counted = [rows, many[:-1][many[:-1, :, -1] > 0][:, :-1]]
    for frames, expected in zip((running, stored), counted, strict=True):
        torch.testing.assert_close(frames.mean[:-1], expected.mean(0), rtol=1e-5, atol=1e-5)
        variance = expected.var(0, unbiased=False)
        torch.testing.assert_close(frames.variance[:-1], variance, rtol=1e-5, atol=1e-5)
        normal = frames.normalize(many)
        assert torch.equal(normal[..., -1] > 0.9, many[..., -1] > 0)
    assert running.count == len(rows)


@pytest.mark.parametrize("shape", [(3, 8, 8), (5, 1)])
def test_observations_that_are_no_sets(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"read observations \(N, D\), N rows of D entries"):
        settings.Entities().build(shape)
