"""Sets of entities: padding counts nowhere, and what an MLP on the padded vector learns slowly."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Unbounded

from recipes.novelty import Novelty
from torchrl_tit import settings
from torchrl_tit.analysis import count_flows, integrated_gradients, map_attention
from torchrl_tit.datasets import episodes_from_arrays
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.modules import Backbone, make_value
from torchrl_tit.networks import EnhancedTIT, HistoryNetwork

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


def test_padding_is_nothing_new() -> None:
    network = settings.Network(frame=settings.Entities(), history=settings.MLP(), num_frames=1)
    novelty = Novelty(network, Unbounded((SEATS, ENTRIES)))
    _, many = observations(1, 6)
    other = torch.where(many[..., -1:] > 0, many, torch.zeros(())).float()
    for width in (0.0, 0.5):
        cells = [novelty.cells([x], width) for x in (many.float(), other)]
        assert torch.equal(*cells)


def test_flows_and_attributions() -> None:
    network = HistoryNetwork(
        settings.Entities(),
        settings.PairedOuter(),
        observation_shape=(SEATS, ENTRIES),
        num_frames=2,
    )
    assert count_flows(network) == count_flows(EnhancedTIT((SEATS,), num_frames=2))
    policy = TensorDictSequential(Backbone(network.double()), make_value(64).double())
    _, many = observations(3, 2)
    many = many.nan_to_num()
    state = TensorDict({"history": many, "action": torch.zeros(3)}, [3])
    shares = integrated_gradients(policy, state, target="value", steps=128)["observation"]
    zeros = torch.cat([0 * many[..., :-1], many[..., -1:]], -1)
    values = [policy(TensorDict({"history": x}, [3]))["state_value"] for x in (many, zeros)]
    difference = (values[0] - values[1]).squeeze(-1)
    assert (shares.flatten(1).sum(1) - difference).norm() < 0.02 * difference.norm()


def build(frame: Any, hidden: int) -> nn.Module:
    torch.manual_seed(0)
    layers = settings.MLP(hidden_dim=hidden, activation="relu")
    network = HistoryNetwork(frame, layers, observation_shape=(8, 3))
    return nn.Sequential(network, nn.Linear(network.features_dim, 1))


def unexplained(network: nn.Module, updates: int = 100) -> float:
    """The share of a variance that is left: of the distance to the nearest of up to 8 points."""
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    errors, targets = [], []
    for update in range(updates):
        sets = 2 * torch.rand(128, 8, 3, generator=generator) - 1
        present = (
            torch.rand(128, 8, generator=generator).argsort(1) <= torch.arange(128)[:, None] % 8
        )
        sets = torch.cat([sets[..., :2], torch.ones(128, 8, 1)], -1) * present.unsqueeze(-1)
        distances = sets[..., :2].norm(dim=-1).masked_fill(~present, torch.inf)
        target = distances.min(1, keepdim=True).values
        error = network(sets.unsqueeze(1)) - target
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()
        if update >= updates - 20:
            errors.append(error.detach())
            targets.append(target)
    return (torch.cat(errors).square().mean() / torch.cat(targets).var()).item()


def test_it_learns_what_an_mlp_on_the_padded_vector_does_not() -> None:
    """With fewer weights; it is wrong by a fraction of what the MLP is wrong by."""
    entities = build(settings.Entities(num_blocks=1), hidden=64)
    mlp = build(settings.Flat(), hidden=256)
    sizes = [sum(p.numel() for p in network.parameters()) for network in (entities, mlp)]
    assert sizes[0] < sizes[1]
    assert unexplained(entities) < 0.3
    assert unexplained(mlp) > 0.5


@pytest.mark.parametrize("shape", [(3, 8, 8), (5, 1)])
def test_observations_that_are_no_sets(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"read observations \(N, D\), N rows of D entries"):
        settings.Entities().build(shape)
