"""CoBERL against its parts in a row; its contrastive loss against the formula."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tests.networks.maps import attention_maps
from tests.networks.reference import randomize
from torchrl_tit.histories.coberl import CoBERL as CoBERLEncoder
from torchrl_tit.layers import GRUGate, init_orthogonal_
from torchrl_tit.networks import CoBERL, HistoryNetwork, ResNet, masked_predictions
from torchrl_tit.objectives import contrastive_prediction_loss

SMALL: dict[str, Any] = {"embed_dim": 12, "num_heads": 3, "features_dim": 8}


def encode(network: HistoryNetwork, history: Tensor) -> Tensor:
    """The tokens of the frames, [B, K, D]."""
    return network.frames[0](history)[:, :, 0]


def test_network_is_transformer_gate_and_lstm() -> None:
    network = CoBERL((20, 20), 4, **SMALL, num_blocks=2)
    randomize(network)
    history = torch.rand(3, 4, 20, 20)
    encoder = network.history_encoder
    assert isinstance(encoder, CoBERLEncoder)
    y = encode(network, history)
    x = y
    for block in encoder.blocks:
        x = block(x, causal=True)
    lstm = nn.LSTM(12, 8, batch_first=True)
    lstm.load_state_dict(encoder.lstm.state_dict())
    states, _ = lstm(encoder.gate(y, x))
    torch.testing.assert_close(network(history), states[:, -1])


def test_gate_bias_starts_near_the_identity_and_survives_initialization() -> None:
    network = CoBERL((20, 20), 4, **SMALL, gate_bias=9)
    init_orthogonal_(network)
    gates = [module for module in network.modules() if isinstance(module, GRUGate)]
    assert len(gates) == 5  # two a block, one before the LSTM
    assert all((gate.bias == 9).all() for gate in gates)
    tokens = torch.randn(2, 4, 1, 12)
    x = tokens[:, :, 0]
    _, through = network.history_encoder.predict_masked(  # type: ignore[operator]
        tokens, torch.zeros(2, 4, dtype=torch.bool)
    )
    torch.testing.assert_close(through, x, rtol=0, atol=0.05)
    assert all((g.bias == 0).all() for g in CoBERL((20, 20), 4).modules() if isinstance(g, GRUGate))


def test_masked_prediction_hides_the_step_and_sees_the_future() -> None:
    network = CoBERL((20, 20), 4, **SMALL)
    randomize(network)
    history = torch.rand(2, 4, 20, 20)
    mask = torch.tensor([[False, True, False, False], [False, False, False, True]])
    encodings, predictions = masked_predictions(network, history, mask)
    assert encodings.shape == predictions.shape == (2, 4, 12)
    torch.testing.assert_close(encodings, encode(network, history))

    # A masked frame changes no prediction.
    changed = torch.where(mask[..., None, None], torch.rand_like(history), history)
    other_encodings, other = masked_predictions(network, changed, mask)
    torch.testing.assert_close(other, predictions)
    assert not torch.allclose(other_encodings[mask], encodings[mask])
    # A later frame does.
    later = history.clone()
    later[0, 3] = 1 - later[0, 3]
    assert (masked_predictions(network, later, mask)[1] - predictions)[0, 1].abs().max() > 1e-3


def test_actor_path_is_causal_and_masks_nothing() -> None:
    network = CoBERL((20, 20), 4, **SMALL)
    history = torch.rand(2, 4, 20, 20)
    network(history).sum().backward()
    assert network.history_encoder.mask_token.grad is None
    for weights in attention_maps(network, history).outer:
        assert weights.shape == (2, 3, 4, 4)
        assert torch.equal(weights, weights.tril())


def test_other_networks_predict_nothing() -> None:
    network = ResNet((20, 20), 4)
    with pytest.raises(TypeError, match=r"StackedCNN cannot predict masked frames.*: take coberl"):
        masked_predictions(network, torch.rand(2, 4, 20, 20), torch.zeros(2, 4, dtype=torch.bool))


def by_hand(encodings, predictions, mask, temperature):
    x, y = (F.normalize(z.flatten(0, 1), dim=-1) for z in (predictions, encodings))
    losses = []
    for t in mask.flatten().nonzero().flatten().tolist():
        p = torch.stack([x[t] @ other for other in y]).div(temperature).softmax(0)
        q = torch.stack([y[t] @ other for other in x]).div(temperature).softmax(0)
        divergence = (q.detach() * (q.detach() / p).log()).sum()  # p alone is trained by it
        losses.append(divergence - p[t].log() - q[t].log())
    return sum(losses) / len(losses)


@pytest.mark.numerics
@pytest.mark.parametrize("temperature", [0.1, 1.0])
def test_equals_the_formula(temperature):
    torch.manual_seed(0)
    given = torch.randn(2, 3, 4, 5, dtype=torch.float64).requires_grad_()
    mask = torch.tensor([[True, False, False, True], [False] * 4, [False, True, False, False]])
    loss = contrastive_prediction_loss(given[0], given[1], mask, temperature=temperature)
    expected = by_hand(given[0], given[1], mask, temperature)
    torch.testing.assert_close(loss, expected)
    (gradient,), (theirs,) = (torch.autograd.grad(x, given) for x in (loss, expected))
    torch.testing.assert_close(gradient, theirs)


def test_it_compiles():
    given, mask = torch.randn(2, 3, 4, 5), torch.rand(3, 4) < 0.5
    compiled = torch.compile(contrastive_prediction_loss, backend="eager", fullgraph=True)
    expected = contrastive_prediction_loss(given[0], given[1], mask, ~mask)
    torch.testing.assert_close(compiled(given[0], given[1], mask, ~mask), expected)


def test_padding_counts_nowhere():
    torch.manual_seed(0)
    given = torch.randn(2, 3, 4, 5, dtype=torch.float64).requires_grad_()
    padding = torch.tensor([[True, True, False, False], [False] * 4, [True, False, False, False]])
    mask = torch.tensor([[True, False, False, True], [False] * 4, [False, True, False, False]])
    loss = contrastive_prediction_loss(given[0], given[1], mask, padding)
    left = given[:, ~padding].unsqueeze(1)  # one history of the others
    expected = contrastive_prediction_loss(left[0], left[1], mask[~padding].unsqueeze(0))
    torch.testing.assert_close(loss, expected)
    (gradient,), (theirs,) = (torch.autograd.grad(x, given) for x in (loss, expected))
    torch.testing.assert_close(gradient, theirs)


def test_the_loss_is_zero_without_masked_steps():
    tensors = torch.randn(2, 2, 3, 4, requires_grad=True)
    mask = torch.zeros(2, 3, dtype=torch.bool)
    loss = contrastive_prediction_loss(tensors[0], tensors[1], mask)
    assert loss == 0
    (gradient,) = torch.autograd.grad(loss, tensors)
    assert not gradient.any()
