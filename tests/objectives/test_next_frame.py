"""Self-supervised losses equal their formulas, written out step by step."""

import pytest
import torch
from torch import nn

from tests.numerics import assert_near
from torchrl_tit import EnhancedTIT
from torchrl_tit.objectives import NextFrameLoss, ReconstructionLoss

N, T, A = 2, 5, 3


@pytest.fixture
def tit():
    return EnhancedTIT((4,), num_frames=3, patch_size=2, embed_dim=8, num_blocks=2).double()


@pytest.fixture
def given(tit):
    is_init = torch.tensor([[False, False, True, False, False], [True, False, False, False, True]])
    features = torch.randn(N, T, tit.features_dim, dtype=torch.float64, requires_grad=True)
    actions = torch.randn(N, T, A, dtype=torch.float64)
    return features, actions, [torch.randn(N, T, 4, dtype=torch.float64)], is_init


def make(tit, **settings):
    return NextFrameLoss(tit.frames, tit.features_dim, A, hidden_dim=16, **settings).double()


@pytest.mark.numerics
def test_next_frame_by_hand(tit, given):
    features, actions, (observations,), is_init = given
    loss = make(tit)
    (encoder,) = tit.frames
    losses = []
    for n in range(N):
        for t in range(T - 1):
            if is_init[n, t + 1]:
                continue  # the next observation belongs to another episode
            guess = loss.predictor(torch.cat([features[n, t], actions[n, t]]))
            tokens = encoder(observations[n, t + 1])
            for row, token in zip(guess.view_as(tokens), tokens, strict=True):
                losses.append(1 - row @ token / (row.norm() * token.norm()))
    assert len(losses) == 6 * encoder.num_tokens
    assert_near(loss(*given), torch.stack(losses).mean())


def test_gradients_reach_the_features_and_not_the_targets(tit, given):
    loss = make(tit)
    loss(*given).backward()
    features, _, _, is_init = given
    used = ~is_init[:, 1:]
    assert (features.grad[:, :-1].abs().sum(-1) > 0).equal(used)
    assert not features.grad[:, -1].any()
    assert all(p.grad is None for p in [*loss.target.parameters(), *tit.parameters()])
    assert all(p.grad is not None for p in loss.predictor.parameters())


def test_targets_follow_slowly(tit):
    loss = make(tit, decay=0.75)
    before = [p.clone() for p in loss.target.parameters()]
    with torch.no_grad():
        for parameter in tit.parameters():
            parameter.add_(1)
    assert all(p.equal(b) for p, b in zip(loss.target.parameters(), before, strict=True))
    loss.update_target(tit.frames)
    for parameter, old in zip(loss.target.parameters(), before, strict=True):
        assert_near(parameter, old + 0.25)


def test_no_step_has_a_next_one(tit, given):
    features, actions, observations, is_init = given
    assert make(tit)(features, actions, observations, torch.ones_like(is_init)) == 0


@pytest.mark.numerics
def test_reconstruction_by_hand():
    image = torch.randint(0, 256, (N, T, 1, 3, 2), dtype=torch.uint8)
    array = torch.randn(N, T, 4, dtype=torch.float64)
    features = torch.randn(N, T, 7, dtype=torch.float64)
    loss = ReconstructionLoss([(1, 3, 2), (4,)], 7, hidden_dim=5).double()
    pixels, entries = (decoder(features) for decoder in loss.decoders)
    expected = (pixels - image.double().flatten(2) / 255).square().mean() + (
        entries - array
    ).square().mean()
    assert_near(loss(features, [image, array]), expected)


def test_reconstruction_is_learnt():
    torch.manual_seed(0)
    array, features = torch.randn(64, 4), nn.Parameter(torch.randn(64, 8))
    loss = ReconstructionLoss([(4,)], 8)
    adam = torch.optim.Adam([features, *loss.parameters()], lr=1e-2)
    first = loss(features, [array]).item()
    for _ in range(60):
        adam.zero_grad()
        value = loss(features, [array])
        value.backward()
        adam.step()
    assert value.item() < first / 5
