"""The baselines under PyTorch's tools, and what all of them share: bytes, shapes, errors."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.layers import init_normal_, init_orthogonal_
from torchrl_tit.networks import (
    D2RL,
    MLP,
    Catformer,
    CoBERL,
    EnhancedTIT,
    NatureCNN,
    OFENet,
    ResNet,
)

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

# Network, observation shape, number of frames, settings.
CASES: dict[str, tuple[type[Any], tuple[int, ...], int, dict[str, Any]]] = {
    "nature cnn": (NatureCNN, (36, 36), 2, {"features_dim": 12}),
    "resnet": (ResNet, (3, 12, 16), 2, {"features_dim": 12}),
    "catformer": (Catformer, (12, 16), 3, {"embed_dim": 12, "num_heads": 3, "features_dim": 8}),
    "coberl": (CoBERL, (12, 16), 3, {"embed_dim": 12, "num_heads": 3, "features_dim": 8}),
    "mlp": (MLP, (5,), 3, {"hidden_dim": 12}),
    "ofenet": (OFENet, (5,), 1, {"hidden_dim": 12}),
    "d2rl": (D2RL, (5,), 1, {"hidden_dim": 12}),
}
IMAGES = [NatureCNN, ResNet, Catformer, CoBERL]
ARRAYS = [MLP, OFENet, D2RL]
every_network = pytest.mark.parametrize("name", CASES)
# Bytes, and two trunks; test_pairs.py traces every encoder.
traced_networks = pytest.mark.parametrize("name", ["resnet", "d2rl"])


def make(name: str, seed: int = 0) -> nn.Module:
    kind, shape, history, settings = CASES[name]
    torch.manual_seed(seed)
    network = kind(shape, history, **settings)
    assert isinstance(network, nn.Module)
    return network


def make_history(name: str, *leading: int) -> Tensor:
    _, shape, history, _ = CASES[name]
    return torch.randint(0, 256, (*leading, history, *shape), dtype=torch.uint8)


def as_tuple(features: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return features if isinstance(features, tuple) else (features,)


def loss(features: Tensor | tuple[Tensor, ...]) -> Tensor:
    return torch.stack([x.square().sum() for x in as_tuple(features)]).sum()


@pytest.fixture(autouse=True)
def _fresh_compiler() -> Iterator[None]:
    yield
    torch.compiler.reset()


@traced_networks
def test_compile_in_one_graph_equals_eager(name: str) -> None:
    network, history = make(name), make_history(name, 4)
    compiled = torch.compile(network, fullgraph=True, backend="aot_eager")
    results = []
    for call in (network, compiled):
        network.zero_grad()
        features = call(history)
        loss(features).backward()
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        results.append([*as_tuple(features), *gradients])
    assert_near(results[1], results[0])


@traced_networks
def test_export(name: str) -> None:
    network, history = make(name).eval(), make_history(name, 4)
    exported = torch.export.export(network, (history,)).module()
    assert_near(exported(history), network(history))


@every_network
def test_vmap_over_stacked_parameters(name: str) -> None:
    networks = [make(name, seed).eval() for seed in range(2)]
    parameters, buffers = stack_module_state(networks)
    history = make_history(name, 4)

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> tuple[Tensor, ...]:
        return as_tuple(functional_call(networks[0], (parameters, buffers), (history,)))

    features = torch.vmap(call)(parameters, buffers)
    expected = [torch.stack(x) for x in zip(*(as_tuple(n(history)) for n in networks), strict=True)]
    assert_near(list(features), expected)


@every_network
def test_copies_compute_the_same_and_are_apart(name: str) -> None:
    network, history = make(name), make_history(name, 2)
    expected = as_tuple(network(history))
    fresh = make(name, seed=1)
    file = io.BytesIO()
    torch.save(network.state_dict(), file)
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    for other in (copy.deepcopy(network), fresh):
        torch.testing.assert_close(as_tuple(other(history)), expected, rtol=0, atol=0)
        randomize(other, seed=3)
    torch.testing.assert_close(as_tuple(network(history)), expected, rtol=0, atol=0)


@every_network
def test_autocast_to_bfloat16_stays_close(name: str) -> None:
    network, history = make(name).float(), make_history(name, 8)
    expected = as_tuple(network(history))
    with torch.autocast("cpu", torch.bfloat16):
        features = as_tuple(network(history))
    loss(features).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())
    for ours, theirs in zip(features, expected, strict=True):
        assert 1e-5 < (ours.float() - theirs).norm() / theirs.norm() < 0.05


@every_network
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_whole_network_in_another_float_type(name: str, dtype: torch.dtype) -> None:
    network, history = make(name), make_history(name, 4)
    expected = as_tuple(network(history))
    for ours, theirs in zip(as_tuple(network.to(dtype)(history)), expected, strict=True):
        assert ours.dtype == dtype
        error = (ours.double() - theirs).norm() / theirs.norm()
        assert error < (1e-5 if dtype == torch.float32 else 0.1)


@every_network
def test_bytes_are_divided_by_255_and_leading_dimensions_are_free(name: str) -> None:
    network, history = make(name), make_history(name, 2, 3)
    expected = as_tuple(network(history.flatten(0, 1).double() / 255))
    for ours, theirs in zip(as_tuple(network(history)), expected, strict=True):
        assert_near(ours.flatten(0, 1), theirs)
    for ours, theirs in zip(as_tuple(network(history[0, 0])), expected, strict=True):
        assert_near(ours, theirs[0])


@every_network
def test_no_rows_give_no_rows(name: str) -> None:
    network = make(name)
    for features in as_tuple(network(make_history(name, 0))):
        assert features.shape == (0, network.features_dim)


@every_network
def test_orthogonal_covers_every_linear_layer_and_convolution(name: str) -> None:
    network = make(name)
    layers = [m for m in network.modules() if isinstance(m, nn.Linear | nn.Conv2d)]
    assert layers
    init_orthogonal_(network)
    for layer in layers:
        matrix = layer.weight.flatten(1)
        matrix = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
        assert_near(matrix @ matrix.T, 2 * torch.eye(len(matrix)))
        assert layer.bias is None or not layer.bias.any()
    # What it leaves alone is not a layer: attention's input projections, the LSTM, positions,
    # tokens, gate biases and LayerNorms.
    owned = {id(p) for layer in layers for p in layer.parameters()}
    rest = {n.split(".")[-1] for n, p in network.named_parameters() if id(p) not in owned}
    assert rest <= {
        *("weight", "bias", "positions", "mask_token", "content_bias", "distance_bias"),
        *("in_proj_weight", "in_proj_bias"),
        *(f"{kind}_{part}_l0" for kind in ("weight", "bias") for part in ("ih", "hh")),
    }


@every_network
def test_normal_covers_every_linear_layer(name: str) -> None:
    network = make(name)
    init_normal_(network)
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            assert 0.01 < layer.weight.std() < 0.03
            assert layer.bias is None or not layer.bias.any()


@pytest.mark.parametrize("kind", IMAGES)
def test_image_networks_refuse_arrays(kind: type[Any]) -> None:
    with pytest.raises(ValueError, match=r"\(17,\) is that of an array, but this encoder reads im"):
        kind((17,), 2)
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 4, 84, 84\]"):
        kind((84, 84), 4)(torch.zeros(2, 84, 84))
    with pytest.raises(ValueError, match=r"num_frames must be at least 1, not 0"):
        kind((84, 84), 0)


@pytest.mark.parametrize("kind", ARRAYS)
def test_array_networks_read_the_entries_of_images_too(kind: type[Any]) -> None:
    network = kind((3, 4), 2)
    arrays = kind((12,), 2)
    arrays.load_state_dict(network.state_dict())
    images = torch.randint(0, 256, (5, 2, 3, 4), dtype=torch.uint8)
    torch.testing.assert_close(network(images), arrays(images.flatten(2)))
    with pytest.raises(ValueError, match=r"num_frames must be at least 1, not 0"):
        kind((5,), 0)


def test_unknown_hyperparameter_is_named() -> None:
    for kind in (MLP, Catformer, EnhancedTIT):
        message = rf"^{kind.__name__}\(\) got an unexpected keyword argument 'width'"
        with pytest.raises(TypeError, match=message):
            kind((20, 20), 2, width=3)
